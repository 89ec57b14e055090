"""PyBullet's clients: given back, and missed in one line."""

import gc
import resource
from dataclasses import replace

import numpy as np
import pybullet
import pytest

from flowrep.envs import StreetEnv


def clients():
    return sum(bool(pybullet.isConnected(physicsClientId=i)) for i in range(100))


def test_streets_of_one_scene_share_a_client_until_the_last_one_is_closed(straight_road):
    gc.collect()  # so that no forgotten street is collected between two counts
    own_scene, before = replace(straight_road, name="clients"), clients()
    streets = [StreetEnv(own_scene, sensors=()) for _ in range(3)]
    other = StreetEnv(replace(own_scene, name="other_clients"), sensors=())
    assert clients() == before + 2
    for env in streets[:2]:
        env.close()
        env.close()  # does nothing
    streets[2].reset(seed=0)
    streets[2].step(0)
    assert clients() == before + 2
    streets[2].close()
    assert clients() == before + 1
    other.close()
    assert clients() == before


@pytest.mark.slow
def test_streets_that_share_a_client_keep_their_exits_and_people_apart():
    # Both stand in one world: each is asked in turn, and must not see the other's.
    paths = "south_to_north", "north_to_south"

    def street(path):
        env = StreetEnv("h_shaped_pathways", renderer="pybullet")
        env.reset(options={"path": path, "episode_seed": 7})
        return env

    alone = [[env.step(i)[0] for i in range(3)] for env in map(street, paths)]
    envs = [street(path) for path in paths]
    shared = zip(*[[env.step(i)[0] for env in envs] for i in range(3)])
    for one, other in zip(alone, shared, strict=True):
        np.testing.assert_equal(list(one), list(other))


@pytest.mark.slow
def test_memory_stays_flat_over_streets():
    def some(count):
        for _ in range(count):
            env = StreetEnv(sensors=())
            env.reset(seed=0)
            env.close()
        gc.collect()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    first = some(3)
    # PyBullet keeps what it is given: without care that is 1.3 MB a street.
    assert some(8) - first < 5 * 1024
