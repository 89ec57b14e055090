"""Drives to be looked at."""

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="the simulated street is driven")

from flowrep.baselines import drives, never_turn
from flowrep.envs import StreetEnv
from flowrep.experiment.viewing import CategoryCount, view_episode


def test_an_episode_is_what_it_is_when_nobody_looks():
    env = StreetEnv("three_way_junction", sensors=())
    (drive,) = drives(env, never_turn, 1, seed=4)
    seen = []
    viewed = view_episode(env, never_turn, look=seen.append, seed=4)
    env.close()
    assert (viewed.episode_seed, viewed.outcome) == (drive.episode_seed, drive.outcome)
    assert (viewed.steps, viewed.total_reward) == (drive.steps, drive.total_reward)
    assert len(seen) == len(viewed.points_m) == viewed.steps + 1
    # From the middle of the start zone, at 10 m/s and 12 steps a second, straight along x.
    np.testing.assert_allclose(viewed.points_m[:3], [(7, 0), (7 + 10 / 12, 0), (7 + 20 / 12, 0)])
    assert viewed.row()["return"] == round(-5 + 0.01 * viewed.steps, 2)


def test_the_path_can_be_chosen():
    env = StreetEnv("three_way_junction", sensors=())
    chosen = [view_episode(env, never_turn, path="right", seed=i).path for i in range(6)]
    env.close()
    assert chosen == ["right"] * 6


def test_pixels_are_counted_by_category():
    count = CategoryCount(("sky", "road", "car"))
    count({"semantic": np.array([[[0, 1, 1, 9]]], dtype=np.uint8)})
    count({"semantic": np.array([[[1, 1, 1, 1]]], dtype=np.uint8)})
    # 8 pixels: 1 of sky (id 0), 6 of road (id 1), 1 of a car (id 9); the road is in both pictures.
    assert count.rows() == [
        {"category": "sky", "pixels": 1, "pixels_percent": 12.5, "pictures_percent": 50.0},
        {"category": "road", "pixels": 6, "pixels_percent": 75.0, "pictures_percent": 100.0},
        {"category": "car", "pixels": 1, "pixels_percent": 12.5, "pictures_percent": 50.0},
    ]
