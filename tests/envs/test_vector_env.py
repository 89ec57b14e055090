"""Streets that are drawn all at once are the streets alone, bit for bit."""

from copy import deepcopy
from functools import partial

import numpy as np
import pytest

from flowrep.envs import Outcome, StreetEnv
from flowrep.envs.sensing import SENSORS
from flowrep.envs.street_env import hit_name
from flowrep.envs.vector_env import StreetVectorEnv
from tests.comparing import differing

NUM_ENVS = 3


def make(**arguments):
    return StreetVectorEnv([partial(StreetEnv, "h_shaped_pathways", **arguments)] * NUM_ENVS)


@pytest.mark.slow_after_first
@pytest.mark.parametrize("sensors", [SENSORS, ("depth", "prev_from_curr")], ids=str)
def test_streets_drawn_together_equal_single_streets(make_street, sensors):
    vector = make(sensors=sensors)
    streets = [make_street("h_shaped_pathways", sensors=sensors) for _ in range(NUM_ENVS)]
    paths = [path.name for path in streets[0].scene.paths]

    def assert_seen(observation, alone):
        assert observation in vector.observation_space
        for i, (seen, info) in enumerate(alone):
            together = {key: value[i] for key, value in observation["sensor"].items()}
            assert differing(together, seen) == []
            status = {key: observation[key][i].tolist() for key in ("outcome", "hit", "path")}
            assert Outcome(status["outcome"][0]).label == info["outcome"]
            assert hit_name(status["hit"][0]) == info["hit"]
            assert paths[status["path"][0]] == info["path"]
            assert observation["episode_seed"][i] == info["episode_seed"]

    rng, resets = np.random.default_rng(0), 0
    alone = [street.reset(seed=5 + i) for i, street in enumerate(streets)]
    assert_seen(vector.reset(seed=5)[0], alone)
    for _ in range(8):
        actions = rng.integers(3, size=NUM_ENVS)
        steps = [street.step(action) for street, action in zip(streets, actions)]
        observation, rewards, ended, truncated, _ = vector.step(actions)
        alone = [(seen, info) for seen, *_, info in steps]
        assert_seen(observation, alone)
        assert rewards.tolist() == [step[1] for step in steps]
        assert ended.tolist() == [step[2] for step in steps]
        assert not truncated.any()
        due = ended | (rng.random(NUM_ENVS) < 0.15)
        if due.any():
            resets += 1
            seeds = [int(rng.integers(100)) if each else None for each in due]
            for i in np.flatnonzero(due):
                alone[i] = streets[i].reset(seed=seeds[i])
            assert_seen(vector.reset(seed=seeds, options={"reset_mask": due})[0], alone)
    assert resets > 1


def test_environments_with_different_cameras_are_not_drawn_together():
    one, other = (
        partial(StreetEnv, scene, sensors=("prev_from_curr",))
        for scene in ("straight_road", "h_shaped_pathways")
    )
    StreetVectorEnv([one, one]).close()
    with pytest.raises(ValueError, match="scene"):
        StreetVectorEnv([one, other])


def test_the_largest_episode_seed_is_in_the_observation_space():
    vector = make(sensors=("frame",))
    observation, _ = vector.reset(options={"episode_seed": (1 << 62) - 1})
    assert observation in vector.observation_space
    assert vector.observation_space.sample() in vector.observation_space
    vector.close()


@pytest.mark.parametrize("mask", [(True, False, False), (False, False, False)])
def test_a_partial_reset_returns_copies_and_zeros_of_what_was_not_yet_seen(mask):
    ours = make(sensors=("depth",))
    options, others = {"reset_mask": np.array(mask)}, ~np.array(mask)
    before, _ = ours.reset(options=dict(options))
    assert not before["sensor"]["depth"][others].any()  # not seen yet: zeros, as workers have
    ours.reset(seed=1)
    last = ours.step(np.array([0, 1, 2]))[0]
    kept = deepcopy(last)
    again, _ = ours.reset(options=dict(options))
    np.testing.assert_array_equal(*(seen["sensor"]["depth"][others] for seen in (again, last)))
    again["sensor"]["depth"][:] = 0.0
    assert differing(last, kept) == []
    assert ours.step(np.zeros(NUM_ENVS, dtype=int))[0]["sensor"]["depth"].any()


def test_poses_computed_ahead_equal_those_at_the_step(make_street):
    env = make_street("three_way_junction", sensors=(), frame_rate_hz=10.0)
    env.reset(options={"episode_seed": 3, "vehicle_speed_mps": 0.0})
    for _ in range(40):
        env.step(0)
        seconds = env.episode.now.ticks * env.episode.tick_s
        np.testing.assert_array_equal(env.episode.poses, env.episode.crowd.poses(seconds))
