import pytest


@pytest.fixture(scope="session", autouse=True)
def open_streets():
    """Streets of one scene share what takes longest to build, as long as one of them is open."""
    from flowrep.envs import StreetEnv

    streets = [StreetEnv(scene, sensors=()) for scene in ("straight_road", "h_shaped_pathways")]
    yield
    for street in streets:
        street.close()
