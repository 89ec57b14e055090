"""The single pass equals PyTorch's passes over the pixels, bit for bit."""

import math

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

from flowrep.extras import compiled
from flowrep.geometry import closed_form, ego_flow, factorize, numba_flow, rigid_flow
from flowrep.geometry import flow as flow_module
from tests.geometry.scenes import HEIGHT, MOTION, OTHER_MOTION, WIDTH, K, depth_map, rigid

pytest.importorskip("numba")

UNKNOWN = torch.full((4, 4), math.nan, dtype=torch.float64)
FROM_BEHIND = rigid((0.0, 0.0, 0.0), (0.0, 0.0, -9.0))
LEAST = float(np.float32(closed_form.LEAST_POSITIVE))


@pytest.fixture
def calls(monkeypatch):
    """Lists the arguments of each call of the single pass."""
    seen, compute = [], numba_flow.planes
    monkeypatch.setattr(numba_flow, "planes", lambda *a, **k: seen.append(a) or compute(*a, **k))
    return seen


def scene(dtype=torch.float32):
    """Three maps with every kind of invalid pixel; of five bodies, one is seen in each map."""
    depth = depth_map(3)
    depth[:, 0, 0, :4] = torch.tensor([math.inf, math.nan, 0.0, -2.0])  # on bodies
    depth[:, 0, 4, :4] = torch.tensor([math.inf, math.nan, -math.inf, 1e-9])  # beside them
    depth[:, 0, 4, 4:6] = torch.tensor([LEAST, np.nextafter(np.float32(LEAST), np.float32(0))])
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


def by_torch(compute, *args, **options):
    """Returns what PyTorch computes without the kernel."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flow_module, "numba_is_installed", lambda: False)
        return compute(*args, **options)


def assert_same_bits(ours, theirs):
    for part, other in zip(ours, theirs):
        assert part.dtype == other.dtype
        assert torch.equal(part.view(torch.uint8), other.view(torch.uint8))


@pytest.mark.parametrize("dt", [1.0, 0.3, [0.5, math.nan, 0.1], [0.5, 0.25, 0.1]])
@pytest.mark.parametrize("zooms", [False, True])
@pytest.mark.parametrize("ids", [None, torch.uint8, torch.int32, torch.int64])
def test_flow_of_bodies_and_of_a_camera(calls, ids, zooms, dt):
    depth, instance, Ks, motions = scene()
    is_known = not zooms and dt != [0.5, math.nan, 0.1]  # the second map
    dt = torch.tensor(dt) if isinstance(dt, list) else dt
    before = 1.2 * Ks if zooms else None
    if zooms:
        before[1, 0, 0] = math.nan  # the second map's K isn't known
    compute, inputs = ego_flow, (depth, Ks, motions[:, 0])
    if ids is not None:
        compute, inputs = rigid_flow, (depth, instance.to(ids), Ks, motions)
    flow = compute(*inputs, dt=dt, prev_K=before)
    assert_same_bits(flow, by_torch(compute, *inputs, dt=dt, prev_K=before))
    assert len(calls) == 1
    assert flow.valid[0, 0, 4].tolist() == [True, False, False, False, True, False, True]
    assert bool(flow.valid[1].any()) == is_known


def test_factors_equal_pytorchs_alone_and_beside_raw_flow(calls):
    depth, instance, Ks, motions = scene()
    raw = rigid_flow(depth, instance, Ks, motions)  # with its mask
    spoilt = raw.flow.clone()
    spoilt[0, 0, 1, :4] = torch.tensor([math.nan, math.inf, -2e38, 4.0])
    for given in (raw, spoilt):
        factors = factorize(given, depth, Ks, motions[:, 0])
        assert not factors.obj[0, :, 3:].any()  # exactly 0 on what stands still
        assert_same_bits(factors, by_torch(factorize, given, depth, Ks, motions[:, 0]))
    assert len(calls) == 3
    assert factors.valid[0, 0, 1, :4].tolist() == [False, False, False, True]
    drifted = motions[:, 0] + 0.01
    inputs = depth, instance, Ks, motions, drifted
    raw, factors = flow_module.rigid_factors(*inputs, prev_K=1.1 * Ks)
    assert_same_bits(raw, by_torch(flow_module.rigid_factors, *inputs, prev_K=1.1 * Ks)[0])
    assert_same_bits(factors, by_torch(factorize, raw, depth, Ks, drifted, prev_K=1.1 * Ks))


def test_a_gradient_of_raw_flow_alone(calls):
    depth, _, Ks, motions = scene()
    raw = torch.ones(3, 2, HEIGHT, WIDTH, requires_grad=True)
    factorize(raw, depth, Ks, motions[:, 0]).obj.sum().backward()
    valid = ego_flow(depth, Ks, motions[:, 0]).valid
    assert torch.equal(raw.grad, valid.expand_as(raw).float())


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_one_camera_for_any_batch(calls, batch):
    depth = depth_map(*batch).float()
    instance = (torch.arange(HEIGHT * WIDTH) % 2).reshape(1, HEIGHT, WIDTH).expand_as(depth)
    others = instance, K.float(), torch.stack([MOTION, OTHER_MOTION]).float()
    one_map = depth[(0,) * len(batch)].expand_as(depth)  # strides of 0
    for maps in (depth, one_map):
        assert_same_bits(rigid_flow(maps, *others), by_torch(rigid_flow, maps, *others))
    assert len(calls) == 2


@pytest.mark.parametrize("id_", [-1, 6])
def test_an_id_without_a_motion_is_named(id_):
    depth, instance, Ks, motions = scene()
    instance = instance.to(torch.int16)
    instance[1, 0, 2, 3] = id_
    with pytest.raises(RuntimeError, match=rf"ids {min(id_, 0)} to {max(id_, 4)}.* 6 rows"):
        rigid_flow(depth, instance, Ks, motions)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float64])
def test_other_floats_are_left_to_pytorch(calls, dtype):
    depth, instance, Ks, motions = scene(dtype)
    assert rigid_flow(depth, instance, Ks, motions).flow.dtype == dtype
    rigid_flow(depth, instance, Ks.float(), motions.float())
    assert len(calls) == (dtype is torch.float32)


def test_gradients_are_pytorch_s(calls):
    depth, camera, motion = depth_map(2).float(), K.float(), MOTION.float()
    for leaf in (depth, camera, motion):
        leaf.requires_grad_()
        ego_flow(depth, camera, motion).flow.sum().backward()
        assert leaf.grad.abs().sum() > 0
        with torch.no_grad():
            assert not ego_flow(depth, camera, motion).flow.requires_grad
        leaf.requires_grad_(False)
    assert len(calls) == 3


def test_forward_derivatives_and_vmap_are_pytorch_s(calls):
    depth, camera = depth_map(2).float(), K.float()

    def flow(motion):
        return ego_flow(depth, camera, motion).flow

    motions = torch.stack([MOTION, OTHER_MOTION]).float()
    mapped = torch.func.vmap(flow)(motions)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(motions[0], torch.ones(4, 4))
        assert forward_ad.unpack_dual(flow(dual)).tangent.abs().sum() > 0
    assert not calls
    for motion, result in zip(motions, mapped):
        torch.testing.assert_close(result, flow(motion))
    assert len(calls) == 2


def test_a_folder_that_cannot_be_written_is_no_hindrance(monkeypatch):
    from numba.core import caching

    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    assert compiled()(lambda number: number + 1)(2) == 3
