"""What all transforms share: errors that help, "next", compilation."""

import functools
import pickle
import re
import shutil
import sys

import pytest
import torch
from tensordict import TensorDict
from torch._dynamo.testing import CompileCounter
from torchrl.collectors import Collector
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv, check_env_specs
from torchrl.envs.transforms import (
    Compose,
    ConditionalSkip,
    FrameSkipTransform,
    MultiAction,
    NoopResetEnv,
    Transform,
)

from flowrep import transforms as T
from flowrep.geometry import ego_flow
from flowrep.transforms.representations import DropKeys
from tests.transforms.fake_env import (
    INTRINSICS,
    FakeSensorEnv,
    SelfResettingEnv,
    camera_motion,
    moments,
)
from tests.transforms.oracles import brightening, same_bits


@pytest.mark.slow
def test_compiled_flow_goes_through_torch_compile_and_stays_picklable(monkeypatch):
    # Traced without compiling C++: geometry's tests cover the real one.
    counter = CompileCounter()
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=counter))
    monkeypatch.setattr(shutil, "which", lambda name: name)
    T.base._compiled.cache_clear()
    td, transform = moments(2), T.RawFlow(INTRINSICS, compiled=True)
    for each in (transform, pickle.loads(pickle.dumps(transform))):
        assert torch.equal(each(td.clone())["raw"], T.RawFlow(INTRINSICS)(td.clone())["raw"])
    assert counter.frame_count == 1  # for all instances
    T.base._compiled.cache_clear()


def test_without_a_compiler_compiled_flow_is_refused(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.setenv("CXX", "clang++-19")
    with pytest.raises(ValueError, match=r"C\+\+.*clang\+\+-19"):
        T.RawFlow(INTRINSICS, compiled=True)


def test_missing_key_is_named_with_what_the_env_offers_before_the_first_step():
    env = TransformedEnv(FakeSensorEnv(), T.Depth(in_keys=["range"]))
    # KeyError would quote the sentence.
    with pytest.raises(KeyError, match=r"^\w.*'depth'.*'range'.*'depth'\)"):
        env.observation_spec  # noqa: B018


def test_missing_key_is_named_on_a_batch_with_all_that_need_it():
    td = moments(2).exclude(("sensor", "depth"))
    with pytest.raises(KeyError, match=r"'ego'.*'obj'.*\('sensor', 'depth'\)"):
        T.FlowFactorize(INTRINSICS, outputs=["ego", "obj"])(td)
    transform = T.Depth()
    transform.set_missing_tolerance(True)  # as TorchRL sometimes asks for
    assert "depth" not in transform(td)


def test_next_without_any_input_is_left_alone_and_with_some_an_error():
    td = moments(2)
    td["next"] = TensorDict({"reward": torch.ones(2, 1)}, [2])
    assert list(T.Depth()(td.clone())["next"].keys()) == ["reward"]
    td["next", "sensor"] = {"depth": td["sensor", "depth"]}
    with pytest.raises(KeyError, match="prev_from_curr"):
        T.FlowFactorize(INTRINSICS, outputs=["ego"])(td)


def test_keywords_instead_of_a_tensordict():
    depth = torch.full((1, 2, 3), 50.0)
    assert torch.equal(T.Depth()(sensor_depth=depth), depth / 100)


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("depth", torch.ones(2, 5, 7), r"\('sensor', 'depth'\) should be float \[\*B, 1, H, W\]"),
        ("depth", torch.ones(2, 1, 5, 7).long(), r"float \[\*B, 1, H, W\].*got torch.int64"),
        ("instance", torch.ones(2, 1, 5, 7), r"integer \[\*B, 1, H, W\].*got torch.float32"),
        ("instance", torch.ones(2, 1, 7, 5).byte(), r"H = 5, W = 7.*\[2, 1, 7, 5\]"),
        ("instance_motion", torch.eye(4).expand(2, 4, 4), r"\[\*B, 1 \+ N, 4, 4\].*\[2, 4, 4\]"),
    ],
)
def test_wrong_layout_is_refused_on_a_batch(key, value, expected):
    td = moments(2)
    td["sensor", key] = value
    with pytest.raises(ValueError, match=expected):
        T.RawFlow(INTRINSICS)(td)


@pytest.mark.parametrize("batch", [[], [4], [2, 3], [1]])
def test_a_map_without_channels_is_refused(batch):
    stack = T.FrameStack(k=2, in_keys=["grey"], out_keys=["grey2"])
    spec = Composite(grey=Unbounded((*batch, 5, 7)), shape=batch)
    with pytest.raises(ValueError, match=re.escape(f"C0, H0, W0] with *B = {batch}; ")):
        stack.transform_observation_spec(spec)


def test_maps_may_have_more_batch_dims_than_their_tensordict():
    cameras = TensorDict({"depth": torch.ones(2, 3, 1, 5, 7)}, [2])
    assert T.Depth(in_keys="depth", out_keys="near")(cameras)["near"].shape == (2, 3, 1, 5, 7)


@pytest.mark.parametrize("name", ["world_from_cam", "K"])
def test_values_are_checked_at_resets_of_their_own_rows_and_in_batches_but_not_in_steps(name):
    key = ("sensor", name)
    checks = T.AdaptPose(in_keys=key, out_keys="out")
    if name == "K":
        checks = T.RawFlow(key, prev_intrinsics=key, out_keys="out")
    td, others = moments(3), torch.tensor([[True], [False], [True]])
    td[key][1] *= -1.0
    assert "out" in checks._reset(TensorDict({"_reset": others}, [3]), td.clone())
    assert "out" in checks._step(td, td.clone())
    for begins in ({}, {"_reset": ~others}):
        with pytest.raises(ValueError, match=f"{name}|pose"):
            checks._reset(TensorDict(begins, [3]), td.clone())
    with pytest.raises(ValueError, match=rf"({name}'\)|pose)\[1\]"):
        checks(td)


def test_mistakes_in_a_subclass_of_map_transform_are_named():
    with pytest.raises(TypeError, match=r"MapTransform: reads are layouts.*DEPTH.*\['raw'\]"):
        T.base.MapTransform(["raw"], "raw", "out")

    class Bare(T.Depth):
        def compute(self, depth):
            return depth

    with pytest.raises(TypeError, match=r"Bare.compute should return a tuple.*'depth'.*Tensor"):
        Bare()(moments(2))


class OwnSkip(Transform):
    """Steps the env twice, as whoever writes a frame skip for themselves does."""

    def _step(self, tensordict, next_tensordict):
        return self.parent.step(tensordict)["next"]


noop = functools.partial(NoopResetEnv, 1, random=False)


def by_poses() -> list[Transform]:
    keys = [("sensor", "depth"), "motion"]
    split = T.FlowFactorize(INTRINSICS, outputs=["ego"], in_keys=keys)
    return [T.CameraMotion(out_keys="motion"), split]


@pytest.mark.parametrize("make", [lambda: FrameSkipTransform(2), noop, OwnSkip])
@pytest.mark.parametrize("is_first", [True, False])
def test_the_motion_of_the_envs_last_step_is_refused_where_others_step_it(make, is_first):
    parts = [make(), T.FlowFactorize(INTRINSICS, outputs=["ego"])]
    stack = Compose(*(parts if is_first else reversed(parts)))
    with pytest.raises(ValueError, match=r"'prev_from_curr'.*steps.*poses.*CameraMotion"):
        TransformedEnv(FakeSensorEnv(), stack).reset()  # as a loop that reads no specs


def with_flow(*before: Transform, after: tuple[Transform, ...] = ()) -> TransformedEnv:
    return TransformedEnv(FakeSensorEnv(), Compose(*before, *by_poses(), *after))


@pytest.mark.parametrize(
    "make",
    [
        with_flow,
        lambda skip: with_flow(after=(skip,)),
        lambda skip: TransformedEnv(SerialEnv(1, with_flow), skip),
    ],
    ids=["first", "last", "outside of the worker"],
)
def test_poses_give_the_flow_between_two_observations_though_a_frame_lies_between(make):
    seen = make(FrameSkipTransform(2)).rollout(1)["next"].squeeze(0)
    once = camera_motion(1, 0)
    want = ego_flow(seen["sensor", "depth"], torch.tensor(INTRINSICS), once @ camera_motion(2, 0))
    torch.testing.assert_close(seen["ego"], want.flow, atol=1e-4, rtol=1e-4)


def test_several_actions_in_one_step_need_an_env_of_their_own():
    several = TransformedEnv(FakeSensorEnv(), MultiAction())
    with pytest.raises(ValueError, match=r"MultiAction.*CameraMotion.*auto_unwrap=False"):
        TransformedEnv(several, Compose(*by_poses()), auto_unwrap=True).reset()
    env = TransformedEnv(several, Compose(*by_poses()), auto_unwrap=False)
    seen = env.step(env.reset().set("action", torch.tensor([0, 0])))["next"]
    torch.testing.assert_close(seen["motion"], camera_motion(1, 0) @ camera_motion(2, 0))


def test_envs_of_a_batch_that_skip_a_step_keep_what_they_had():
    def rollout(env: EnvBase) -> TensorDict:
        stack = T.FrameStack(k=3, in_keys=[("sensor", "depth")], out_keys=["depth3"])
        at_step_1 = ConditionalSkip(lambda td: td["sensor", "depth"][..., 0, 0] == 2.01)
        env = TransformedEnv(env, Compose(*by_poses(), stack, at_step_1))
        return env.rollout(3)

    both = rollout(SerialEnv(2, [FakeSensorEnv, lambda: FakeSensorEnv((), 1)]))
    alone = rollout(FakeSensorEnv())
    for key in ("motion", "ego", "depth3"):
        assert same_bits(both["next", key][0], alone["next", key]), key
    assert both["next", "motion"][0, -1].equal(camera_motion(1, 0))


class Agents(EnvBase):
    """Three agents with a camera each, in a group with its own batch size."""

    def __init__(self) -> None:
        super().__init__()
        self.cameras = FakeSensorEnv((3,))
        self.observation_spec = Composite(agents=self.cameras.observation_spec.clone())
        self.action_spec = Composite(
            agents=Composite(action=self.cameras.action_spec.clone(), shape=[3])
        )
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict=None, **kwargs):
        return TensorDict({"agents": self.cameras._reset().select("sensor")})

    def _step(self, tensordict):
        seen = self.cameras._step(tensordict["agents"])
        ended = {key: seen[key].any(0) for key in ("done", "terminated")}
        return TensorDict({"agents": seen.select("sensor"), "reward": torch.ones(1), **ended})

    def _set_seed(self, seed):
        """Everything is deterministic."""


def test_the_state_of_several_agents_keeps_their_batch_size():
    camera = T.CameraMotion(in_keys=("agents", "sensor", "world_from_cam"), out_keys="motion")
    env = TransformedEnv(Agents(), camera)
    assert env.state_spec["agents", "sensor"].shape == (3,)
    check_env_specs(env, seed=None)


def test_a_transform_that_steps_at_a_reset_is_refused_after_camera_motion():
    with pytest.raises(ValueError, match=r"NoopResetEnv.*CameraMotion.*put it first"):
        with_flow(after=(noop(),)).reset()


def test_envs_that_reset_themselves_give_the_same_first_frames():
    depth, rgb = ("sensor", "depth"), ("sensor", "rgb")

    def rollout(env: FakeSensorEnv) -> TensorDict:
        pictures = T.FrameStack(k=2, in_keys=[rgb], out_keys=["rgb2"])
        stack = Compose(*by_poses(), pictures, T.EstimatedFlow(brightening), DropKeys("motion"))
        # A Compose in a Compose, as `representation_stack` in a stack of one's own.
        return TransformedEnv(env, Compose(stack)).rollout(9, break_when_any_done=False)

    own, reset = rollout(SelfResettingEnv((2,))), rollout(FakeSensorEnv((2,)))
    for key in (depth, "ego", "rgb2", "raw"):
        assert same_bits(own[key], reset[key]), key
    for flow in ("ego", "raw"):  # of an episode's first frame, and of no other, is 0
        still = (own[flow] == 0).flatten(2).all(-1)
        assert still.nonzero().tolist() == [[0, 0], [0, 3], [0, 6], [1, 0], [1, 4], [1, 8]]


def rollouts_of(env: int) -> TensorDict:
    """Returns a rollout that ends before its episode does."""
    return FakeSensorEnv((), env).rollout(2)


NO_TRAJECTORIES = {
    "joined": lambda: torch.cat([rollouts_of(0), rollouts_of(1)]),
    "shuffled": lambda: FakeSensorEnv().rollout(3)[torch.tensor([1, 0, 2])],
    "every second": lambda: FakeSensorEnv((), 1).rollout(4)[::2],
}


@pytest.mark.parametrize("make", NO_TRAJECTORIES.values(), ids=list(NO_TRAJECTORIES))
@pytest.mark.parametrize(
    "transform", [T.CameraMotion(), T.FrameStack(in_keys=("sensor", "rgb"), out_keys="rgb2")]
)
def test_steps_out_of_order_are_no_trajectory_although_torchrl_still_names_their_time(
    make, transform
):
    td = make().exclude(("sensor", "prev_from_curr"), ("next", "sensor", "prev_from_curr"))
    assert td.names == ["time"]
    with pytest.raises(ValueError, match="no episode ends there"):
        transform(td)


def test_trajectories_may_be_padded_by_split_trajectories():
    env = TransformedEnv(FakeSensorEnv((2,)), T.CameraMotion(out_keys="motion"))
    (online,) = Collector(env, frames_per_batch=10, total_frames=10, split_trajs=True)
    mask = online["collector", "mask"]
    assert not mask.all()
    offline = T.CameraMotion(out_keys="motion")(
        online.exclude("motion", ("next", "motion")).refine_names(None, "time")
    )
    assert same_bits(offline["motion"][mask], online["motion"][mask])
