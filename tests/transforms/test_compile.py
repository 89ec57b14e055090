"""Every transform's computation compiles to one graph for any batch, and never waits for a GPU."""

from __future__ import annotations

import pytest
import torch
from torch._dynamo.testing import CompileCounter

from flowrep.transforms import (
    AdaptDepth,
    AdaptFlow,
    AdaptPose,
    CameraMotion,
    InstanceIds,
    InstanceMotion,
    RawFlow,
    SensorNoise,
)
from flowrep.transforms.frame_stack import push_frame
from flowrep.transforms.noise import drifted_motion, noisy_depth
from tests.transforms.fake_env import INTRINSICS
from tests.transforms.test_base import TRANSFORMS, inputs, moments

POSE = ("sensor", "world_from_cam")
MORE = {
    "ray length": lambda: AdaptDepth(
        "ray_length", intrinsics=INTRINSICS, in_keys=("sensor", "depth"), out_keys="z"
    ),
    "z-buffer": lambda: AdaptDepth(
        "z_buffer", near_m=0.1, far_m=50.0, in_keys=("sensor", "depth"), out_keys="z"
    ),
    "pose": lambda: AdaptPose(
        direction="world_to_camera", axes="ned", in_keys=POSE, out_keys="world_from_cam"
    ),
    "flow": lambda: AdaptFlow(
        direction="backward", grid="current", channels="row_column", in_keys="raw", out_keys="own"
    ),
    "ids": lambda: InstanceIds([3, 1], in_keys=("sensor", "semantic")),
    "camera motion": CameraMotion,
    "instance motion": InstanceMotion,
    "K under a key": lambda: RawFlow(("sensor", "K")),
    "noise, off": SensorNoise,
}
# What runs once a step beside `compute`, as functions of the maps of two moments.
STEPS = {
    "camera step": lambda td: (
        lambda before, now: CameraMotion().between([before], [now]),
        [td[POSE].flip(0), td[POSE]],
    ),
    "instance step": lambda td: (
        lambda *poses: InstanceMotion().between(poses[:2], poses[2:]),
        [
            *(td["sensor", key].flip(0) for key in ("world_from_cam", "world_from_body")),
            *(td["sensor", key] for key in ("world_from_cam", "world_from_body")),
        ],
    ),
    "next stack": lambda td: (
        push_frame,
        [td["sensor", "rgb"].repeat(1, 3, 1, 1), td["sensor", "rgb"]],
    ),
    "depth noise": lambda td: (
        lambda depth, a, b: noisy_depth(depth, a, b, sigma_per_m=0.1, dropout=0.2),
        [td["sensor", "depth"], td["raw"][:, :1], td["raw"][:, 1:]],
    ),
    "noise by frame": lambda td: (
        SensorNoise(
            depth_sigma_per_m=0.1, depth_dropout=0.2, drift_m=0.1, drift_rad=0.2, frame_key="frame"
        ).compute,
        [
            td["sensor", "depth"],
            td["sensor", "prev_from_curr"],
            torch.arange(2 * len(td), device=td.device).reshape(-1, 2),
        ],
    ),
    "drift": lambda td: (
        lambda motion, normal: drifted_motion(motion, normal, drift_m=0.1, drift_rad=0.2),
        [td["sensor", "prev_from_curr"], td["raw"][:, 0, 0, :6]],
    ),
}


def cases() -> dict[str, object]:
    """Returns functions from a batch of moments to (a function, its tensors)."""

    def of(make):
        return lambda td: ((transform := make()).compute, inputs(transform, td))

    return {**{name: of(make) for name, make in {**TRANSFORMS, **MORE}.items()}, **STEPS}


each_case = pytest.mark.parametrize("case", cases().values(), ids=list(cases()))


def outputs(result) -> list[torch.Tensor]:
    return [result] if isinstance(result, torch.Tensor) else [*result]


@pytest.mark.slow_after_first
@each_case
def test_one_graph_for_all_batches(case):
    torch._dynamo.reset()
    function, _ = case(moments(11))
    counter = CompileCounter()  # counts graphs, and runs them eagerly
    compiled = torch.compile(function, fullgraph=True, dynamic=True, backend=counter)
    for batch in (11, 2, 3, 5, 8):  # first one that equals no other size: torch would tie the two
        _, given = case(moments(batch))
        for got, want in zip(outputs(compiled(*given)), outputs(function(*given))):
            assert torch.equal(got.nan_to_num(), want.nan_to_num())
    assert counter.frame_count <= 1  # a function that returns its input has none
    compiled(*case(moments(1))[1])  # torch makes a graph of its own for size 1
    assert counter.frame_count <= 2
    torch._dynamo.reset()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@each_case
def test_nothing_waits_for_the_gpu(case):
    td = moments(3).to("cuda")
    function, given = case(td)
    if (owner := getattr(function, "__self__", None)) is not None:
        owner.to("cuda")
    want = outputs(function(*given))  # what is set up once may wait
    torch.cuda.set_sync_debug_mode("error")
    try:
        got = outputs(function(*given))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert all(a.is_cuda and a.shape == b.shape for a, b in zip(got, want))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_noise_is_drawn_on_the_gpu_without_waiting():
    options = {"depth_sigma_per_m": 0.1, "depth_dropout": 0.1, "drift_m": 0.1, "drift_rad": 0.1}
    noise = SensorNoise(**options)
    td = moments(3).to("cuda")
    noise.compute(*inputs(noise, td))
    torch.cuda.set_sync_debug_mode("error")
    try:
        depth, motion = noise.compute(*inputs(noise, td))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert depth.is_cuda
    assert motion.is_cuda
