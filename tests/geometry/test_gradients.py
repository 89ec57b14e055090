"""Differentiable in depth, K and motion, with masked pixels in the image."""

import math

import torch
from torch.autograd import gradcheck

from flowrep.geometry import ego_flow, factorize, rigid_flow
from tests.geometry.scenes import HEIGHT, MOTION, OTHER_MOTION, WIDTH, K, depth_map


def depth_with_every_mask() -> torch.Tensor:
    depth = depth_map()
    depth[0, 0, :5] = torch.tensor([math.inf, math.nan, 0.0, -2.0, -math.inf])
    depth[0, 0, 5] = 1.5  # behind the previous camera of BACKED_OFF
    return depth.requires_grad_()


BACKED_OFF = MOTION.clone()
BACKED_OFF[2, 3] = -2.0


def leaves(*tensors: torch.Tensor) -> list[torch.Tensor]:
    return [tensor.clone().requires_grad_() for tensor in tensors]


def test_ego_flow():
    K_leaf, motion = leaves(K, BACKED_OFF)
    depth = depth_with_every_mask()
    assert ego_flow(depth, K, BACKED_OFF).valid[0, 0].tolist() == [True] + 5 * [False] + [True]
    assert gradcheck(lambda *given: ego_flow(*given, dt=0.5).flow, (depth, K_leaf, motion))


def test_rigid_flow():
    instance = torch.arange(HEIGHT * WIDTH).reshape(1, HEIGHT, WIDTH) % 2
    K_leaf, motions = leaves(K, torch.stack([BACKED_OFF, OTHER_MOTION]))
    depth = depth_with_every_mask()
    assert gradcheck(
        lambda depth, K, motions: rigid_flow(depth, instance, K, motions).flow,
        (depth, K_leaf, motions),
    )


def test_factorize():
    raw = torch.ones(2, HEIGHT, WIDTH, dtype=torch.float64)
    raw[0, 2, 2] = math.nan
    raw_leaf, K_leaf, motion = leaves(raw, K, BACKED_OFF)
    depth = depth_with_every_mask()
    assert gradcheck(lambda *given: factorize(*given)[:2], (raw_leaf, depth, K_leaf, motion))


def test_masked_pixels_send_back_zero_not_nan():
    # With an epsilon instead of two masks the gradient at depth 0 is about 1/eps^2, and
    # 0 * inf = nan spreads from it to K and motion.
    depth = depth_with_every_mask()
    K_leaf, motion = leaves(K, MOTION)
    ego_flow(depth, K_leaf, motion).flow.square().sum().backward()
    assert depth.grad[0, 0, :5].tolist() == [0.0] * 5
    assert depth.grad[0, 1:].abs().min() > 0
    assert K_leaf.grad.isfinite().all()
    assert motion.grad.isfinite().all()
    assert motion.grad[:3].abs().min() > 0


def test_a_point_level_with_the_previous_camera_sends_back_zero_not_nan():
    # 2 m ahead after backing off by 2 m: its previous depth is exactly 0, flow there 0/0.
    level = torch.eye(4, dtype=torch.float64)
    level[2, 3] = -2.0
    depth = torch.tensor([[[2.0, 5.0]]], dtype=torch.float64, requires_grad=True)
    K_leaf, motion = leaves(K, level)
    ego_flow(depth, K_leaf, motion).flow.sum().backward()
    assert depth.grad[0, 0, 0].item() == 0.0
    assert depth.grad[0, 0, 1].item() != 0.0
    assert K_leaf.grad.isfinite().all()
    assert motion.grad.isfinite().all()


def test_gradient_by_hand():
    # u = -fx * t / Z with fx = 4, t = 0.5, Z = 4: du/dZ = fx t / Z^2, du/dfx = -t/Z, du/dt = -fx/Z.
    camera, motion = leaves(torch.tensor([[4.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]]),
                            torch.eye(4))  # fmt: skip
    with torch.no_grad():
        motion[0, 3] = 0.5
    depth = torch.full((1, 1, 1), 4.0, requires_grad=True)
    ego_flow(depth, camera, motion).flow[0].sum().backward()
    assert depth.grad.item() == 0.125
    assert camera.grad[0, 0].item() == -0.125
    assert motion.grad[0, 3].item() == -1.0
