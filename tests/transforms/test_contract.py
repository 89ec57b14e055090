"""TorchRL's contract for a transform: by each, in every kind of env, as a module and on replay.

What each output must be is worked out pixel by pixel in `oracles`, from the frame's moment alone.
"""

import copy
import functools
import pickle
from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv, check_env_specs
from torchrl.envs.transforms import Compose, Transform

from flowrep import transforms as T
from tests.transforms import oracles
from tests.transforms.fake_env import INTRINSICS, NUM_CLASSES, FakeSensorEnv, frame, moment
from tests.transforms.oracles import same_bits

STEPS = 5  # the shortest episode has 3: a rollout crosses resets

# From one frame's sensor maps to what an output must be.
Oracle = Callable[[dict[str, Tensor]], Tensor]
KEY, POSE = ("sensor", "K"), ("sensor", "world_from_cam")
PICTURES, FACTORS = [("sensor", "rgb"), ("sensor", "semantic")], ["ego", "obj", "raw", "valid"]
BACKWARD = {"direction": "backward", "grid": "current", "channels": "row_column"}
INVERTED = {"direction": "world_to_camera", "axes": "opengl"}


class Case(NamedTuple):
    make: Callable[[], Transform]
    oracles: dict[NestedKey, Oracle]
    before: Callable[[], list[Transform]] = list  # what has to run before the transform
    carries: bool = False  # single transitions can't tell their past: they store the root's outputs


def the_same(name: str) -> Oracle:
    return functools.partial(oracles.sensor_map, name)


def stacked(name: str, k: int) -> Oracle:
    return functools.partial(oracles.stacked, name, k=k)


def raw_flow() -> list[Transform]:
    return [T.RawFlow(INTRINSICS)]


STACK: dict[NestedKey, Oracle] = {
    "obj": oracles.obj,
    "raw": oracles.raw,
    "ego": oracles.ego,
    "depth": oracles.depth,
    "seg": the_same("semantic"),
    "rgb": the_same("rgb"),
    "seg2": stacked("semantic", 2),
}

# Whatever two of them write under one key is the same.
CASES = {
    "Segmentation": Case(lambda: T.Segmentation(NUM_CLASSES), {"seg": the_same("semantic")}),
    "Segmentation, onehot": Case(
        lambda: T.Segmentation(NUM_CLASSES, encoding="onehot", out_keys="onehot"),
        {"onehot": oracles.onehot},
    ),
    "Depth": Case(
        lambda: T.Depth(range_m=14.0, out_keys="near"),
        {"near": functools.partial(oracles.depth, range_m=14.0)},
    ),
    "Rgb": Case(T.Rgb, {"rgb": the_same("rgb")}),
    "RawFlow": Case(
        lambda: T.RawFlow(
            KEY, prev_intrinsics=KEY, outputs=["raw", "valid"], out_keys=[("own", "raw"), "known"]
        ),
        {("own", "raw"): oracles.raw, ("own", "raw_valid"): oracles.valid, "known": oracles.valid},
    ),
    "FlowFactorize": Case(
        lambda: T.FlowFactorize(INTRINSICS, outputs=FACTORS, out_keys=["a", "b", "c", "d"]),
        {"a": oracles.ego, "b": oracles.obj, "c": oracles.raw, "d": oracles.valid},
        before=raw_flow,
    ),
    "FrameStack": Case(
        lambda: T.FrameStack(k=3, in_keys=PICTURES, out_keys=[("stack", "rgb"), ("stack", "ids")]),
        {("stack", "rgb"): stacked("rgb", 3), ("stack", "ids"): stacked("semantic", 3)},
        carries=True,
    ),
    "EstimatedFlow": Case(
        lambda: T.EstimatedFlow(oracles.brightening, out_keys="estimated"),
        {"estimated": oracles.minus_one_but_at_resets},
        before=lambda: [T.FrameStack(k=2, in_keys=[("sensor", "rgb")], out_keys=["rgb2"])],
    ),
    "AdaptDepth": Case(
        lambda: T.AdaptDepth(
            "ray_length", intrinsics=INTRINSICS, in_keys=("sensor", "depth"), out_keys="z"
        ),
        {"z": oracles.ray_length_to_z},
    ),
    "AdaptPose": Case(
        lambda: T.AdaptPose(**INVERTED, in_keys=POSE, out_keys=("adapted", "pose")),
        {("adapted", "pose"): oracles.inverted_opengl_pose},
    ),
    "AdaptFlow": Case(
        lambda: T.AdaptFlow(**BACKWARD, in_keys="raw", out_keys="measured"),
        {"measured": oracles.rows_backward},
        before=raw_flow,
    ),
    "InstanceIds": Case(
        lambda: T.InstanceIds(
            [3, 1], static_ids=[0, 2], in_keys=("sensor", "semantic"), out_keys="rows"
        ),
        {"rows": functools.partial(oracles.rows_of_classes, bodies=[3, 1])},
    ),
    "CameraMotion": Case(
        lambda: T.CameraMotion(out_keys=[("own", "motion")]),
        {("own", "motion"): the_same("prev_from_curr")},
        carries=True,
    ),
    "PreviousIntrinsics": Case(
        lambda: T.PreviousIntrinsics(out_keys=("own", "K")),
        {("own", "K"): the_same("K")},
        carries=True,
    ),
    "InstanceMotion": Case(
        lambda: T.InstanceMotion(out_keys=[("own", "motions")]),
        {("own", "motions"): the_same("instance_motion")},
        carries=True,
    ),
    "EstimateCameraMotion": Case(
        lambda: T.EstimateCameraMotion(INTRINSICS, outputs=["motion"], out_keys=["estimate"]),
        {"estimate": the_same("prev_from_curr")},
        before=raw_flow,
    ),
    "SensorNoise, off": Case(
        lambda: T.SensorNoise(out_keys=["noisy_depth", "noisy_motion"]),
        {"noisy_depth": the_same("depth"), "noisy_motion": the_same("prev_from_curr")},
    ),
    "SensorNoise without any echo": Case(
        lambda: T.SensorNoise(sensors=["depth"], depth_dropout=1.0, out_keys="holes"),
        {"holes": oracles.hole},
    ),
    "representation_stack": Case(
        lambda: T.representation_stack(list(STACK), intrinsics=INTRINSICS, num_classes=NUM_CLASSES),
        STACK,
        carries=True,
    ),
}

each_case = pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))


@functools.cache
def wanted(oracle: Oracle, at: tuple[int, int, int]) -> Tensor:
    return oracle(frame(*at))


def assert_right(td: TensorDictBase, oracles: dict[NestedKey, Oracle]) -> None:
    """Compares each output, of each element of the batch, with its oracle, now and under next."""
    for part in (td, td["next"]):
        flat = part.reshape(-1)
        moments = [moment(depth) for depth in flat["sensor", "depth"]]
        for key, oracle in oracles.items():
            want = torch.stack([wanted(oracle, at) for at in moments])
            assert flat[key].dtype == want.dtype
            torch.testing.assert_close(flat[key], want, atol=2e-5, rtol=1e-5, equal_nan=True)


def rollout(env: EnvBase) -> TensorDictBase:
    return env.rollout(STEPS, break_when_any_done=False)


@pytest.fixture(scope="module")
def trajectory() -> TensorDictBase:
    return rollout(FakeSensorEnv((3,)))


@pytest.fixture
def inputs(case, trajectory) -> TensorDictBase:
    """A trajectory of three envs that holds what the transform reads."""
    return Compose(*case.before())(trajectory.clone())


@each_case
def test_in_a_single_env(case):
    env = TransformedEnv(FakeSensorEnv((), 1), Compose(*case.before(), case.make()))
    check_env_specs(env, seed=None)
    assert_right(rollout(env), case.oracles)


@each_case
def test_in_a_batched_env_and_offline_to_the_last_bit(case, inputs):
    env = TransformedEnv(FakeSensorEnv((3,)), Compose(*case.before(), case.make()))
    online = rollout(env)
    assert_right(online, case.oracles)
    copied = copy.deepcopy(pickle.loads(pickle.dumps(case.make())))
    for offline in (Compose(case.make())(inputs.clone()), copied(inputs.clone())):
        assert all(same_bits(offline[key], inputs[key]) for key in inputs.keys(True, True))
        for key in case.oracles:
            assert same_bits(offline[key], online[key])
            assert same_bits(offline["next", key], online["next", key])
    check_env_specs(env, seed=None)
    assert set(case.oracles) <= set(env.observation_spec.keys(True, True))


@each_case
def test_on_shuffled_samples_of_a_replay_buffer(case, inputs):
    if case.carries:
        inputs = case.make()(inputs)
        under_next = [key if isinstance(key, tuple) else (key,) for key in case.oracles]
        inputs = inputs.exclude(*(("next", *key) for key in under_next))
    storage = LazyTensorStorage(64)
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=40, transform=case.make())
    buffer.extend(inputs.reshape(-1))
    torch.manual_seed(0)
    assert_right(buffer.sample(), case.oracles)


@each_case
def test_its_inverse_changes_nothing(case):
    td = TensorDict({"action": torch.tensor([2, 0, 1])}, [3])
    assert (case.make().inv(td) == td).all()


def everything() -> Compose:
    """Returns all transforms at once, as each batched env takes long to start."""
    return Compose(*(part for case in CASES.values() for part in (*case.before(), case.make())))


def everything_in_an_env(first_env: int) -> TransformedEnv:
    return TransformedEnv(FakeSensorEnv((), first_env), everything())


def bare_envs() -> list[Callable[[], EnvBase]]:
    return [functools.partial(FakeSensorEnv, (), env) for env in (0, 1)]


def envs_with_everything() -> list[Callable[[], EnvBase]]:
    made = everything_in_an_env(1)  # travels to its worker as it is, if it has one of its own
    return [functools.partial(everything_in_an_env, 0), functools.partial(copy.deepcopy, made)]


ENVS = {
    "outside of a serial env": lambda: TransformedEnv(SerialEnv(2, bare_envs()), everything()),
    "inside of a serial env": lambda: SerialEnv(2, envs_with_everything()),
    "outside of a parallel env": lambda: TransformedEnv(
        ParallelEnv(2, bare_envs(), mp_start_method="fork"), everything()
    ),
    "inside of forked workers": lambda: ParallelEnv(
        2, envs_with_everything(), mp_start_method="fork"
    ),
}


@pytest.mark.parametrize(
    "make", [pytest.param(make, marks=pytest.mark.slow, id=name) for name, make in ENVS.items()]
)
def test_in_several_envs(make):
    env = make()
    try:
        check_env_specs(env, seed=None)
        td = rollout(env)
    finally:
        env.close()
    for case in CASES.values():
        assert_right(td, case.oracles)
