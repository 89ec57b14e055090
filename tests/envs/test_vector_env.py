"""Streets that are seen all at once are the streets of gymnasium's own vector, bit for bit."""

from functools import partial

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from flowrep.envs import StreetEnv
from flowrep.envs.sensing import SENSORS
from flowrep.envs.vector_env import SensorObservation, StreetVectorEnv

NUM_ENVS = 3


def sensed(**arguments):
    return SensorObservation(StreetEnv("h_shaped_pathways", **arguments))


@pytest.fixture
def both():
    """Makes one vector of either kind; they are closed when the test ends."""
    made = []

    def make(**arguments):
        factories = [partial(sensed, **arguments)] * NUM_ENVS
        one_by_one = SyncVectorEnv(factories, autoreset_mode=AutoresetMode.DISABLED)
        made.extend([StreetVectorEnv(factories), one_by_one])
        return made[-2:]

    yield make
    for vector in made:
        vector.close()


def assert_same(a, b):
    assert a.keys() == b.keys()
    for key, value in a.items():
        if isinstance(value, dict):
            assert_same(value, b[key])
        else:
            assert value.dtype == b[key].dtype, key
            np.testing.assert_array_equal(value, b[key], err_msg=key)


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"sensors": ()},
        {"sensors": ("depth", "prev_from_curr")},
        {"sensors": SENSORS},
        {"renderer": "pybullet"},
    ],
    ids=str,
)
def test_steps_and_partial_resets_are_those_of_gymnasiums_vector(both, arguments):
    ours, theirs = both(**arguments)
    assert_same(ours.reset(seed=5)[0], theirs.reset(seed=5)[0])
    rng, resets = np.random.default_rng(0), 0
    for _ in range(25):
        actions = rng.integers(3, size=NUM_ENVS)
        steps = [vector.step(actions)[:4] for vector in (ours, theirs)]
        assert_same(steps[0][0], steps[1][0])
        for a, b in zip(steps[0][1:], steps[1][1:]):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
        ended = steps[0][2] | (rng.random(NUM_ENVS) < 0.1)
        if ended.any():
            resets += 1
            options = [{"reset_mask": ended.copy()} for _ in range(2)]
            seeds = [int(rng.integers(100)) if due else None for due in ended]
            assert_same(
                ours.reset(seed=seeds, options=options[0])[0],
                theirs.reset(seed=seeds, options=options[1])[0],
            )
    assert resets > 3


def test_what_was_given_away_stays_as_it_is(both):
    ours, _ = both(sensors=("depth",))
    first, _ = ours.reset(seed=1)
    kept = first["sensor"]["depth"].copy()
    ours.step(np.array([0, 1, 2]))
    mask = np.array([True, False, False])
    again, _ = ours.reset(options={"reset_mask": mask})
    again["sensor"]["depth"][:] = 0.0
    np.testing.assert_array_equal(first["sensor"]["depth"], kept)
    assert ours.step(np.zeros(NUM_ENVS, dtype=int))[0]["sensor"]["depth"].any()


def test_a_reset_of_no_street_returns_what_was_last_seen(both):
    ours, _ = both(sensors=("depth",))
    none = {"reset_mask": np.zeros(NUM_ENVS, dtype=bool)}
    before, _ = ours.reset(options=dict(none))
    assert not before["sensor"]["depth"].any()  # nothing has been seen: zeros, as workers have
    ours.reset(seed=1)
    last = ours.step(np.array([0, 1, 2]))[0]
    again, _ = ours.reset(options=dict(none))
    assert_same(again, last)
    again["sensor"]["depth"][:] = 0.0
    assert last["sensor"]["depth"].any()


def test_a_street_whose_episode_has_ended_is_not_driven_on(both):
    ours, _ = both(sensors=())
    ours.reset(seed=1)
    straight_on, ended = np.zeros(NUM_ENVS, dtype=int), np.zeros(NUM_ENVS, dtype=bool)
    while not ended.any():
        ended = ours.step(straight_on)[2]
    with pytest.raises(RuntimeError, match="call reset"):
        ours.step(straight_on)


def test_people_who_are_foreseen_are_where_their_clock_puts_them(make_street):
    env = make_street("three_way_junction", sensors=(), frame_rate_hz=10.0)
    env.reset(options={"episode_seed": 3, "vehicle_speed_mps": 0.0})
    for _ in range(40):
        env.step(0)
        seconds = env.episode.now.ticks * env.episode.rules.tick_s
        np.testing.assert_array_equal(env.episode.poses, env.episode.crowd.poses(seconds))
