"""Scenes for the tests: Straight Road, and what is left of it without people."""

from dataclasses import replace

import pytest

from flowrep.envs import StreetEnv, load_scene
from flowrep.envs.scene import PedestrianGroup, Walk


@pytest.fixture(scope="session")
def straight_road():
    return load_scene("straight_road")


@pytest.fixture(scope="session")
def empty_road(straight_road):
    """Nobody walks here; the vehicle starts at (0, 0) and looks along x."""
    return replace(straight_road, pedestrian_groups=())


@pytest.fixture(scope="session")
def one_stands(straight_road):
    """One person stands at (30, 0), in the vehicle's way."""
    walk = Walk("points", points_m=((30.0, -0.01), (30.0, 0.01)))
    person = PedestrianGroup("one", 1, 0.0, walk, standing=1)
    return replace(straight_road, pedestrian_groups=(person,))


@pytest.fixture
def make_street():
    """Makes streets that are closed when the test ends."""
    made = []

    def make(*args, **kwargs):
        made.append(StreetEnv(*args, **kwargs))
        return made[-1]

    yield make
    for street in made:
        street.close()
