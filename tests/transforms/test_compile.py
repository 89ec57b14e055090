"""Every transform computes in one graph for any batch, on any device, and never waits for a GPU."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch._dynamo.testing import CompileCounter
from torchrl.envs.transforms import Compose

from flowrep import transforms as T
from tests.transforms.fake_env import INTRINSICS, NUM_CLASSES, moments

KEY, POSE = ("sensor", "K"), ("sensor", "world_from_cam")
POSES = "world_from_cam", "world_from_body"


def camera_step(before: torch.Tensor, now: torch.Tensor) -> tuple[torch.Tensor, ...]:
    return T.CameraMotion().advance([before], [now])


def bodies_step(*poses: torch.Tensor) -> tuple[torch.Tensor, ...]:
    return T.InstanceMotion().advance(poses[:2], poses[2:])


def next_stack(stack: torch.Tensor, frame: torch.Tensor) -> tuple[torch.Tensor, ...]:
    return T.FrameStack(k=3, in_keys=["x"], out_keys=["x3"]).advance([stack], [frame])


NOISE = {"depth_sigma_per_m": 0.1, "depth_dropout": 0.2, "drift_m": 0.1, "drift_rad": 0.2}
TRANSFORMS = {
    "onehot": lambda: T.Segmentation(NUM_CLASSES, encoding="onehot"),
    "depth": T.Depth,
    "K under a key": lambda: T.RawFlow(
        KEY, prev_intrinsics=KEY, scale=0.5, outputs=["raw", "valid"]
    ),
    "ego, obj": lambda: T.FlowFactorize(INTRINSICS, scale=10.0),
    "ray length": lambda: T.AdaptDepth(
        "ray_length", intrinsics=INTRINSICS, in_keys=("sensor", "depth"), out_keys="z"
    ),
    "pose": lambda: T.AdaptPose(
        direction="world_to_camera", axes="ned", in_keys=POSE, out_keys="world_from_cam"
    ),
    "flow": lambda: T.AdaptFlow(
        direction="backward", grid="current", channels="row_column", in_keys="raw", out_keys="own"
    ),
    "ids": lambda: T.InstanceIds([3, 1], in_keys=("sensor", "semantic")),
    "noise by frame": lambda: T.SensorNoise(**NOISE, frame_key="frame"),
}
# What runs once a step beside `compute`, with its maps of two moments.
STEPS = {
    "camera step": lambda td: (camera_step, [td[POSE].flip(0), td[POSE]]),
    "bodies step": lambda td: (
        bodies_step,
        [sensor[key] for sensor in (td["sensor"].flip(0), td["sensor"]) for key in POSES],
    ),
    "next stack": lambda td: (
        next_stack,
        [td["sensor", "rgb"].repeat(1, 3, 1, 1), td["sensor", "rgb"]],
    ),
}


def inputs(transform, td):
    return [td[key] for key in transform.in_keys]


def of(make):
    return lambda td: ((transform := make()).compute, inputs(transform, td))


# Functions from a batch of moments to (a function, its tensors).
CASES = {name: of(make) for name, make in TRANSFORMS.items()} | STEPS
each_case = pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))


def framed(count: int):
    """Moments with names of frames: numbers of episodes and steps."""
    return moments(count).set("frame", torch.arange(2 * count).reshape(-1, 2))


@pytest.mark.slow_after_first
@each_case
def test_one_graph_for_all_batches(case):
    torch._dynamo.reset()
    function, _ = case(framed(11))
    counter = CompileCounter()  # counts graphs, and runs them eagerly
    compiled = torch.compile(function, fullgraph=True, dynamic=True, backend=counter)
    for batch in (11, 2):  # first one that equals no other size: torch would tie the two
        _, given = case(framed(batch))
        for got, want in zip(compiled(*given), function(*given)):
            assert torch.equal(got.nan_to_num(), want.nan_to_num())
    assert counter.frame_count == 1
    torch._dynamo.reset()


SENSORS = ["depth", "instance", "instance_motion", "prev_from_curr", "K"]


class Wrapped(torch.nn.Module):
    """Takes tensors, as a program that is exported has to."""

    def __init__(self, transform):
        super().__init__()
        self.transform = transform

    def forward(self, *sensors):
        td = self.transform(TensorDict({"sensor": dict(zip(SENSORS, sensors))}, [3]))
        return td["raw"], td["obj"]


def test_a_stack_is_compiled_and_exported_and_runs_on_meta_tensors():
    camera = {"intrinsics": KEY, "prev_intrinsics": KEY}
    given = tuple(moments(3)["sensor", name] for name in SENSORS)
    used = Wrapped(Compose(T.RawFlow(**camera), T.FlowFactorize(**camera)))
    want = used(*given)
    torch.compiler.reset()
    compiled = torch.compile(used, fullgraph=True, backend="eager")
    for run in (compiled, torch.export.export(used, given).module()):
        for got, expected in zip(run(*given), want):
            assert torch.equal(got, expected)
    assert all(each.is_meta for each in used.to("meta")(*(x.to("meta") for x in given)))


class Noisy(torch.nn.Module):
    """Draws new noise at each call."""

    def __init__(self):
        super().__init__()
        self.noise = T.SensorNoise(**NOISE, seed=1)

    def forward(self, *maps):
        return self.noise.compute(*maps)


def test_noise_that_is_drawn_anew_is_compiled_and_exported_and_runs_on_meta_tensors():
    eager, given = Noisy(), tuple(inputs(T.SensorNoise(), moments(3)))
    compiled = torch.compile(Noisy(), fullgraph=True, backend="eager")
    exported = torch.export.export(Noisy(), given).module()
    for _ in range(3):
        want = eager(*given)
        for run in (compiled, exported):
            torch.testing.assert_close(run(*given), want, rtol=0, atol=0, equal_nan=True)
    assert all(each.is_meta for each in Noisy().to("meta")(*(x.to("meta") for x in given)))


CHECKED = {
    "AdaptPose": (T.AdaptPose(in_keys="x"), torch.eye(4)),
    "InstanceIds": (T.InstanceIds([3], in_keys="x"), torch.tensor([[[3, 0, 3]]])),
    "Segmentation": (T.Segmentation(3, in_keys="x"), torch.tensor([[[2, 0, 255]]])),
}


@pytest.mark.parametrize(("transform", "given"), CHECKED.values(), ids=list(CHECKED))
def test_transforms_that_check_values_compile_to_one_graph(transform, given):
    (key,), given = transform.out_keys, TensorDict(x=given)
    compiled = torch.compile(transform, fullgraph=True, backend="eager")
    assert torch.equal(compiled(given.clone())[key], transform(given.clone())[key])
    assert transform.to("meta")(given.to("meta"))[key].is_meta


def test_compiled_code_refuses_class_ids_that_would_wrap_too():
    wrong = TensorDict(x=torch.tensor([[[300]]]))
    with pytest.raises(RuntimeError, match="beyond 0 to 255"):
        torch.compile(T.Segmentation(3, in_keys="x"), fullgraph=True, backend="eager")(wrong)


def on(device, case):
    """Returns a case's function and tensors on a device."""
    function, given = case(framed(3).to(device))
    if (owner := getattr(function, "__self__", None)) is not None:
        owner.to(device)
    return function, given


@each_case
def test_moves_to_another_device(case):
    function, given = on("meta", case)
    assert all(output.is_meta for output in function(*given))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@each_case
def test_a_gpu_gives_what_the_cpu_gives_without_waiting(case):
    compute, on_cpu = on("cpu", case)
    want = compute(*on_cpu)
    function, given = on("cuda", case)
    function(*given)  # what is set up once may wait
    torch.cuda.set_sync_debug_mode("error")
    try:
        got = function(*given)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for on_gpu, expected in zip(got, want):
        assert on_gpu.is_cuda
        torch.testing.assert_close(on_gpu.cpu(), expected, atol=1e-5, rtol=1e-5, equal_nan=True)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_noise_is_drawn_on_the_gpu_without_waiting():
    noise = T.SensorNoise(**NOISE)
    td = moments(3).to("cuda")
    noise.compute(*inputs(noise, td))
    torch.cuda.set_sync_debug_mode("error")
    try:
        depth, motion = noise.compute(*inputs(noise, td))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert depth.is_cuda
    assert motion.is_cuda
