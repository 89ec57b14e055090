import pytest


@pytest.fixture(scope="session", autouse=True)
def open_streets():
    """Streets of one scene share what takes longest to build, as long as there is one of them."""
    from flowrep.envs import StreetEnv

    return [StreetEnv(scene, sensors=()) for scene in ("straight_road", "h_shaped_pathways")]
