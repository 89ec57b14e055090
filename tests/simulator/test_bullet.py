"""PyBullet's clients: given back, and missed in one line."""

import gc
import resource
from dataclasses import replace

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
def test_memory_stays_flat_over_streets():
    def some(count):
        for _ in range(count):
            env = StreetEnv(sensors=())
            env.reset(seed=0)
            env.close()
        gc.collect()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    first = some(3)
    assert some(8) - first < 5 * 1024
