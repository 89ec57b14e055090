"""Representations without TorchRL: numpy maps that other learners take as they are."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from flowrep.envs import Outcome, RepresentationObservation, make_env
from flowrep.transforms import REPRESENTATIONS, Depth
from tests.comparing import differing

ID = "flowrep/StraightRoad-v0"
ALL = [name for name in REPRESENTATIONS if name != "rgb"]


@pytest.mark.filterwarnings("ignore:.*Box observation space.*", "ignore:.*unwrapped version.*")
@pytest.mark.parametrize("joined", [True, False])
def test_gymnasiums_own_checks_pass(joined):
    # By its module, as those name it who have not imported it.
    env = gymnasium.make(f"flowrep.envs:{ID}", representations=["ego", "seg2"], joined=joined)
    check_env(env, skip_render_check=True)
    assert env.unwrapped.scene.name == "straight_road"


def test_maps_are_those_of_the_torchrl_env():
    env = gymnasium.make(ID, representations=ALL, joined=False)
    same = make_env("straight_road", ALL, num_envs=1)
    td = same.reset(seed=3)
    # The vector env seeds each street by its own rule: the episode's seed makes them the same.
    observation, _ = env.reset(options={"episode_seed": int(td["episode_seed"])})
    for _ in range(3):
        for name in ALL:
            assert observation[name].shape == tuple(td[name].shape[1:])
            np.testing.assert_array_equal(observation[name], td[name][0].numpy())
        td = same.step(td.set("action", torch.tensor([1])))["next"]
        observation, *_ = env.step(1)


def test_joined_maps_are_finite_float_channels_in_the_order_of_the_names():
    described = {"depth": {}, "seg": {"encoding": "ids"}, "obj": {}}  # as in a run's config.yaml
    env = gymnasium.make(ID, representations=described)
    parts = gymnasium.make(ID, representations=["depth", "seg", "obj"], joined=False)
    for each in (env, parts):
        each.reset(options={"episode_seed": 4})
        each.step(2)
    joined, apart = env.step(2)[0], parts.step(2)[0]
    assert joined.shape == env.observation_space.shape == (1 + 5 + 2, 84, 84)
    assert joined.dtype == np.float32
    assert joined in env.observation_space
    assert np.isfinite(joined).all()
    sky = apart["seg"][0] == 0
    assert sky.any()
    assert (joined[0][sky] == 1.0).all()
    np.testing.assert_array_equal(joined[1:6].argmax(0), apart["seg"][0])
    np.testing.assert_array_equal(joined[1:6].sum(0), 1.0)
    np.testing.assert_array_equal(joined[6:], apart["obj"])


def test_colours_alone_stay_bytes():
    env = gymnasium.make(ID, representations=["rgb"])
    observation, _ = env.reset(seed=0)
    assert env.observation_space == spaces.Box(0, 255, (3, 84, 84), np.uint8)
    assert observation.dtype == np.uint8
    assert observation.max() > 1


@pytest.mark.parametrize("truncate", [False, True])
def test_a_time_out_may_be_a_truncation_and_info_holds_numbers(truncate):
    env = gymnasium.make(ID, representations=["seg"], truncate_timeouts=truncate)
    env.reset(options={"episode_seed": 0, "vehicle_speed_mps": 0.0})  # it never gets anywhere
    ended = False, False
    while not any(ended):
        _, reward, *ended, info = env.step(0)
        assert all(isinstance(value, int | bool) for value in info.values())
    assert ended == [not truncate, truncate]
    assert reward == pytest.approx(-4.99)
    expected = {"outcome": Outcome.TIMEOUT, "hit": 255, "episode_seed": 0, "path": 0}
    assert info == expected | {"is_success": False}


@pytest.mark.parametrize("joined", [True, False])
def test_streets_of_make_vec_are_single_streets_side_by_side(joined):
    options = {"representations": ["obj", "seg2"], "joined": joined, "truncate_timeouts": True}
    ours = gymnasium.make_vec(ID, num_envs=3, **options)
    theirs = gymnasium.make_vec(ID, num_envs=3, vectorization_mode="sync", **options)
    assert ours.observation_space == theirs.observation_space
    assert ours.metadata["autoreset_mode"] == ours.autoreset_mode == theirs.autoreset_mode
    first, _ = ours.reset(options={"reset_mask": np.array([True, False, False])})
    assert first in ours.observation_space
    assert differing(ours.reset(seed=4), theirs.reset(seed=4)) == []
    count = 0
    for _ in range(25):  # the first one turns off the road; the step after that begins anew
        one, other = (envs.step(np.array([1, 0, 0])) for envs in (ours, theirs))
        assert differing(one, other) == []
        count += one[2].any()
    assert count
    assert one[0] in ours.observation_space
    again = {"seed": [7, None, None], "options": {"reset_mask": np.array([True, False, False])}}
    assert differing(*(envs.reset(**again)[0] for envs in (ours, theirs))) == []
    assert differing(*(envs.step([1, 0, 0])[0] for envs in (ours, theirs))) == []
    moving = ours.step([1, 0, 0])[0]
    second, _ = ours.reset(options={"reset_mask": np.array([0, 1, 0])})  # no rows
    for name in second if isinstance(second, dict) else [...]:
        kept = (second[name] == moving[name]).reshape(3, -1).all(1)
        assert kept.tolist() == [True, False, True]


K = [[40.0, 0.0, 2.5], [0.0, 50.0, 1.5], [0.0, 0.0, 1.0]]


class Wall(gymnasium.Env):
    """A wall 2 m ahead of a camera that goes 0.1 m to the right at each step."""

    action_space = spaces.Discrete(1)

    def __init__(self, dtype=np.float32):
        self.wall = np.full((1, 3, 5), 2.0, dtype)
        self.observation_space = spaces.Dict(
            depth=spaces.Box(0, np.inf, (1, 3, 5), dtype),
            prev_from_curr=spaces.Box(-np.inf, np.inf, (4, 4), np.float32),
        )

    def look(self, x_m):
        motion = np.eye(4, dtype=np.float32)
        motion[0, 3] = x_m
        return {"depth": self.wall, "prev_from_curr": motion}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.look(0.0), {}

    def step(self, action):
        return self.look(0.1), 0.0, False, False, {}


def test_spaces_have_the_maps_types():
    for joined, dtype in ((False, np.float64), (True, np.float32)):
        env = RepresentationObservation(Wall(np.float64), ["ego"], intrinsics=K, joined=joined)
        observation, _ = env.reset(seed=0)
        assert observation in env.observation_space
        assert (observation if joined else observation["ego"]).dtype == dtype


def test_an_env_of_ones_own_is_wrapped_by_its_camera():
    env = RepresentationObservation(Wall(), ["ego", "depth"], intrinsics=K)
    observation, _ = env.reset(seed=0)
    assert not observation[:2].any()
    observation, *_ = env.step(0)
    np.testing.assert_allclose(observation[0], -40 * 0.1 / 2)  # u; fy would give -2.5
    np.testing.assert_array_equal(observation[1], 0)
    np.testing.assert_allclose(observation[2], 0.02)
    env = RepresentationObservation(Wall(), ["depth2"], joined=False)
    env.reset()[0]["depth2"][:] = 9.0  # the caller's own, not what the next step reads
    np.testing.assert_allclose(env.step(0)[0]["depth2"], 0.02)
    near = RepresentationObservation(Wall(), {"near": Depth(range_m=4.0, out_keys="near")})
    np.testing.assert_array_equal(near.reset()[0], np.full((1, 3, 5), 0.5))
    with pytest.raises(KeyError, match=r"needs key .*'instance'"):
        RepresentationObservation(Wall(), ["raw"], intrinsics=K)
    Wall.K = np.array(K)
    env = RepresentationObservation(Wall(), ["ego"])
    env.unwrapped.K = Wall.K * [[2.0, 1.0, 1.0]]
    with pytest.raises(ValueError, match=r"K was .*intrinsics="):
        env.reset()
    del Wall.K
    with pytest.raises(ValueError, match="need intrinsics="):
        RepresentationObservation(Wall(), ["ego"])
    with pytest.raises(ValueError, match=r"list of names.*'ego'"):
        RepresentationObservation(Wall(), "ego", intrinsics=K)


def test_flow_of_a_time_needs_no_frame_rate_but_the_env_s():
    flows = []
    for rate_hz in (None, 6.0):
        env = gymnasium.make(ID, representations={"ego": {"rate_hz": rate_hz}}, joined=False)
        env.reset(seed=0)
        flows.append(env.step(0)[0]["ego"])
    step, time = flows
    assert np.abs(step).max() > 1.0
    np.testing.assert_allclose(time, 2 * step, rtol=1e-6)  # 1/6 s is two steps of 1/12 s
