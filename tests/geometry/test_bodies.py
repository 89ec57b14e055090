"""Bodies as a list of pixels equal bodies looked up for every pixel, bit for bit."""

import math
from unittest.mock import patch

import pytest
import torch

from flowrep.geometry import rigid_flow
from flowrep.geometry.bodies import body_planes
from tests.geometry.scenes import HEIGHT, MOTION, OTHER_MOTION, WIDTH, K, depth_map, rigid


@pytest.fixture(autouse=True)
def _no_map_is_small(monkeypatch):
    monkeypatch.setattr("flowrep.geometry.bodies.SMALL", 0)


UNKNOWN = torch.full((4, 4), math.nan, dtype=torch.float64)
FROM_BEHIND = rigid((0.0, 0.0, 0.0), (0.0, 0.0, -9.0))


def scene(dtype):
    """Three maps with every kind of invalid pixel; of five bodies, one is seen in each map."""
    depth = depth_map(3)
    depth[:, 0, 0, :4] = torch.tensor([math.inf, math.nan, 0.0, -2.0])  # on bodies
    depth[:, 0, 4, :4] = torch.tensor([math.inf, math.nan, -math.inf, 1e-9])  # beside them
    motions = torch.stack([MOTION, OTHER_MOTION, UNKNOWN, FROM_BEHIND, MOTION, OTHER_MOTION])
    motions = motions.repeat(3, 1, 1, 1)
    motions[2, 0] = math.nan  # the last map's camera is unknown, its body is not
    instance = torch.zeros(3, 1, HEIGHT, WIDTH, dtype=torch.uint8)
    instance[0, 0, :3, 1:] = 3
    instance[1, 0, :2] = 2
    instance[2, 0, :2, :5] = 1
    instance[2, 0, 3, 6] = 4
    Ks = K.repeat(3, 1, 1)
    Ks[1, 0, 0], Ks[1, 1, 2] = 9.0, 1.7
    return depth.to(dtype), instance, Ks.to(dtype), motions.to(dtype)


def dense(*arguments):
    with patch("torch.compiler.is_compiling", return_value=True):
        return body_planes(*arguments)


@pytest.mark.parametrize("dt", [1.0, 0.25, torch.tensor([0.5, math.nan, 0.1])])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("ids", ["mixed", "none", "all"])
def test_both_forms_agree_in_every_bit(dtype, dt, ids):
    depth, instance, Ks, motions = scene(dtype)
    if ids != "mixed":
        instance = torch.full_like(instance, 0 if ids == "none" else 1)
    dtypes = dtype, torch.promote_types(dtype, torch.float32)
    sparse = body_planes(depth, instance, Ks, motions, dt, dtypes)
    bits = {2: torch.int16, 4: torch.int32, 8: torch.int64}[dtype.itemsize]
    expected = dense(depth, instance, Ks, motions, dt, dtypes)
    for ours, theirs in zip(sparse[:2], expected[:2]):
        assert torch.equal(ours.view(bits), theirs.view(bits))
    assert torch.equal(sparse[2], expected[2])
    assert 0 < sparse[2].sum() < sparse[2].numel()


def test_each_map_s_pixels_follow_its_own_camera_and_body():
    depth, instance, Ks, motions = scene(torch.float64)
    valid = rigid_flow(depth, instance, Ks, motions).valid[:, 0]
    # By hand: body 3 was 9 m further back, so z - 9 > 0.01 z; body 2's motion is unknown, and so
    # is all of the last map except its bodies 1 and 4.
    assert torch.equal(valid[0, :3, 1:], depth[0, 0, :3, 1:] > 9 / 0.99)
    assert not valid[1, :2].any()
    assert valid[1, 2:4].all()
    assert valid[2].sum() == 2 + 5 + 1  # columns 0 and 4 of row 0, row 1, and body 4's pixel


@pytest.mark.parametrize("id_", [-1, 6])
def test_an_id_without_a_motion_is_named(id_):
    depth, instance, Ks, motions = scene(torch.float64)
    instance = instance.to(torch.int16)
    instance[1, 0, 2, 3] = id_
    with pytest.raises(RuntimeError, match=rf"ids {min(id_, 1)} to {max(id_, 4)}.* 6 rows"):
        rigid_flow(depth, instance, Ks, motions)


def test_gradients_are_those_of_the_dense_form():
    depth, instance, Ks, motions = scene(torch.float64)
    motions = torch.where(motions.isfinite(), motions, 0.0)
    dtypes = torch.float64, torch.float64
    weights = torch.linspace(-1.0, 2.0, depth.numel(), dtype=torch.float64).view(3, HEIGHT, WIDTH)

    def gradients(form):
        leaves = [t.clone().requires_grad_() for t in (depth, Ks, motions)]
        u, v, _ = form(leaves[0], instance, leaves[1], leaves[2], 0.5, dtypes)
        (weights * u + weights.flip(1) * v).sum().backward()
        return [leaf.grad for leaf in leaves]

    for sparse, expected in zip(gradients(body_planes), gradients(dense)):
        assert sparse.isfinite().all()
        torch.testing.assert_close(sparse, expected, rtol=1e-12, atol=1e-12)


def test_without_gradients_the_result_is_the_same():
    depth, instance, Ks, motions = scene(torch.float32)
    with_gradient = rigid_flow(depth.requires_grad_(), instance, Ks, motions)
    without = rigid_flow(depth.detach(), instance, Ks, motions)
    assert torch.equal(with_gradient.flow.view(torch.int32), without.flow.view(torch.int32))
    assert torch.equal(with_gradient.valid, without.valid)
