"""Envs that reset themselves within a step: what each representation sees of the new episode."""

from __future__ import annotations

import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose

from flowrep.transforms import CameraMotion, EstimatedFlow, FlowFactorize, FrameStack
from flowrep.transforms.stack import DropKeys
from tests.transforms.contract import same_bits
from tests.transforms.fake_env import INTRINSICS, FakeSensorEnv, SelfResettingEnv

DEPTH, RGB = ("sensor", "depth"), ("sensor", "rgb")


def one_pixel(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """An estimator whose flow is 1 px everywhere."""
    return torch.ones_like(first[:, :2], dtype=torch.float32)


def stack() -> Compose:
    return Compose(
        CameraMotion(out_keys="motion"),
        FlowFactorize(INTRINSICS, outputs=["ego"], in_keys=[DEPTH, "motion"]),
        FrameStack(k=2, in_keys=[RGB], out_keys=["rgb2"]),
        EstimatedFlow(one_pixel),
        DropKeys("motion"),
    )


def test_all_that_is_computed_from_a_first_frame_is_what_a_reset_would_give():
    own = TransformedEnv(SelfResettingEnv((2,)), stack()).rollout(9, break_when_any_done=False)
    reset = TransformedEnv(FakeSensorEnv((2,)), stack()).rollout(9, break_when_any_done=False)
    for key in (DEPTH, "ego", "rgb2", "raw"):
        assert same_bits(own[key], reset[key]), key
    for flow in ("ego", "raw"):  # of an episode's first frame, and of no other, is 0
        still = (own[flow] == 0).flatten(2).all(-1)
        assert still.nonzero().tolist() == [[0, 0], [0, 3], [0, 6], [1, 0], [1, 4], [1, 8]]
