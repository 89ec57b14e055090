"""PyBullet's clients are given back."""

import gc
from dataclasses import replace

import pybullet

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
