"""Ego flow, flow of bodies and their difference: values by hand, masks, laws, mistakes."""

import math
from functools import partial

import pytest
import torch

from flowrep.geometry import adapt_flow, ego_flow, factorize, rigid_flow
from tests.geometry.scenes import (
    HEIGHT,
    MOTION,
    OTHER_MOTION,
    WIDTH,
    K,
    assert_equals_a_loop,
    depth_map,
    flow_pixel_by_pixel,
    instance_map,
    raw_flow,
    rigid,
)

NAN, INF = math.nan, math.inf


def camera(fx=4.0, skew=0.0, cx=1.0, fy=8.0, cy=0.25) -> torch.Tensor:
    return torch.tensor([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def moved(x=0.0, y=0.0, z=0.0) -> torch.Tensor:
    prev_from_curr = torch.eye(4)
    prev_from_curr[:3, 3] = torch.tensor([x, y, z])
    return prev_from_curr


def test_sideways_by_hand():
    # The camera went 0.5 m right and 0.25 m down. At 4 m: u = -4 * 0.5/4, v = -8 * 0.25/4. With fx
    # and fy swapped (-1, -0.25); with curr_from_prev, or previous minus current, (0.5, 0.5).
    flow, valid = ego_flow(torch.full((1, 1, 1), 4.0), camera(), moved(x=0.5, y=0.25))
    assert flow.flatten().tolist() == [-0.5, -0.5]
    assert valid.all()


def test_forwards_by_hand():
    # The camera went 1 m forward, so what stands at 4 m stood at 5 m. Pixel (1, 0) lies (0.5, 0.25)
    # from the principal point and lay at 4/5 of that: flow is a fifth of it, outwards. On the
    # previous frame's grid it would be a third (4 m -> 3 m); unnegated, (-0.1, -0.05). With pixel
    # corners for centres, x would be 0 and flow (0, -0.05).
    flow, _ = ego_flow(torch.full((1, 1, 2), 4.0), camera(), moved(z=1.0))
    torch.testing.assert_close(flow[:, 0, 1].tolist(), [0.1, 0.05])


@pytest.mark.parametrize("motion", [MOTION, rigid((0.4, -0.3, 0.9), (-1.0, 0.5, 1.5))])
def test_agrees_with_brute_force(motion):
    depth = depth_map()
    flow, valid = ego_flow(depth, K, motion)
    assert valid.all()
    torch.testing.assert_close(flow, flow_pixel_by_pixel(depth, K, motion), rtol=0, atol=1e-12)


def test_at_infinity_only_rotation_moves_a_pixel():
    endless = torch.full((1, HEIGHT, WIDTH), INF, dtype=torch.float64)
    rotation_only = MOTION.clone()
    rotation_only[:3, 3] = 0
    flow, valid = ego_flow(endless, K, MOTION)
    assert valid.all()
    assert torch.equal(flow, ego_flow(depth_map(), K, rotation_only).flow)
    assert flow.abs().min() > 0
    assert torch.equal(ego_flow(endless, K, moved(1.0, 2.0, 3.0)).flow, torch.zeros_like(flow))


@pytest.mark.parametrize("depth_m", [NAN, 0.0, -3.0, -INF])
def test_depth_that_is_no_depth_is_invalid(depth_m):
    # -3 m would otherwise give a mirrored flow, 0 m inf.
    flow, valid = ego_flow(torch.tensor([[[depth_m, 3.0]]]), camera(), moved(0.1, 0.2, 0.3))
    assert valid.tolist() == [[[False, True]]]
    assert flow[:, 0, 0].tolist() == [0.0, 0.0]
    assert flow[:, 0, 1].abs().min() > 0


def test_flow_is_per_step_unless_told_seconds():
    depth = depth_map()
    per_step = ego_flow(depth, K, MOTION).flow
    per_second = ego_flow(depth, K, MOTION, dt=0.125).flow
    torch.testing.assert_close(per_second, 8 * per_step, rtol=1e-14, atol=0)


MOTIONS = torch.stack([MOTION, OTHER_MOTION, rigid((0.1, 0.0, 0.2), (1.0, 2.0, 0.5))])


def test_every_pixel_has_the_flow_of_its_own_body():
    depth, instance = depth_map(), instance_map()
    flow, valid = rigid_flow(depth, instance, K, MOTIONS)
    assert valid.all()
    for number, motion in enumerate(MOTIONS):
        riding = (instance == number).expand_as(flow)
        assert riding.any()
        assert torch.equal(flow[riding], ego_flow(depth, K, motion).flow[riding])


@pytest.mark.parametrize(("id_", "held"), [(-1, "-1 to 2"), (3, "0 to 3")])
def test_an_id_without_a_row_is_refused(id_, held):
    instance = instance_map(2, dtype=torch.int32)
    instance[1, 0, 2, 3] = id_
    with pytest.raises(RuntimeError, match=f"instance holds ids {held}.* 0 to 2; .*InstanceIds"):
        rigid_flow(depth_map(2), instance, K, MOTIONS)


def test_ego_is_ego_flow_and_the_parts_add_up():
    raw, depth = raw_flow(), depth_map()
    ego, obj, valid = factorize(raw, depth, K, MOTION, dt=0.5)
    assert valid.all()
    assert torch.equal(ego, ego_flow(depth, K, MOTION, dt=0.5).flow)
    assert torch.equal(obj, raw - ego)


def test_unknown_pixels_have_no_object_flow_and_say_so():
    raw, depth = raw_flow(), depth_map()
    depth[0, 0, 0] = NAN
    raw[0, 1, 1] = NAN
    raw[1, 2, 2] = INF
    raw[:, 3, 3] = torch.tensor([INF, -INF])
    ego, obj, valid = factorize(raw, depth, K, MOTION)
    unknown = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    unknown[[0, 1, 2, 3], [0, 1, 2, 3]] = True
    assert torch.equal(~valid[0], unknown)
    assert obj[:, unknown].abs().max() == 0
    assert torch.equal(obj[:, ~unknown], (raw - ego)[:, ~unknown])
    # The camera's share needs no raw flow: only the pixel without depth lacks it.
    assert ego[:, 0, 0].abs().max() == 0
    assert ego[:, [1, 2, 3], [1, 2, 3]].abs().min() > 0


# Zoomed in, sheared and shifted: no entry is that of K.
PREV_K = torch.tensor([[12.5, 0.4, 3.3], [0.0, 7.2, 2.2], [0.0, 0.0, 1.0]], dtype=torch.float64)


def test_another_k_in_the_previous_frame_agrees_with_brute_force():
    depth, instance = depth_map(), instance_map()
    expected = flow_pixel_by_pixel(depth, K, MOTIONS, PREV_K, instance)
    raw = rigid_flow(depth, instance, K, MOTIONS, prev_K=PREV_K)
    torch.testing.assert_close(raw.flow, expected, rtol=0, atol=1e-12)
    ego, obj, valid = factorize(raw, depth, K, MOTION, prev_K=PREV_K)
    expected = flow_pixel_by_pixel(depth, K, MOTION, PREV_K)
    torch.testing.assert_close(ego, expected, rtol=0, atol=1e-12)
    assert valid.all()
    assert obj[:, instance[0] == 0].abs().max() == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_k_before_changes_nothing_and_nothing_moving_is_exactly_0(dtype):
    depth, camera = depth_map().to(dtype), K.to(dtype)
    alone = ego_flow(depth, camera, MOTION.to(dtype)).flow
    assert torch.equal(ego_flow(depth, camera, MOTION.to(dtype), prev_K=camera).flow, alone)
    depth[..., 0, 0] = INF
    for before in (None, camera):
        still, valid = ego_flow(depth, camera, torch.eye(4, dtype=dtype), prev_K=before)
        assert valid.all()
        assert still.abs().max() == 0


def test_flow_that_needs_no_change_and_flow_that_points_back():
    # The point at column 7, row 2 came from column 4, row 3: p_t - p_t' = (3, -1).
    want = torch.tensor([3.0, -1.0]).reshape(2, 1, 1)
    grid = {"grid": "current"}
    assert torch.equal(adapt_flow(want, direction="forward", **grid), want)
    assert torch.equal(adapt_flow(-want, direction="backward", **grid), want)
    rows_first = torch.tensor([1.0, -3.0]).reshape(1, 2, 1, 1)
    back = adapt_flow(rows_first, direction="backward", channels="row_column", **grid)
    assert torch.equal(back[0], want)


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
@pytest.mark.parametrize("function", [ego_flow, rigid_flow, factorize])
def test_any_batch_equals_a_loop(function, batch):
    generator = torch.Generator().manual_seed(3)
    noise = torch.rand((*batch, 3, 4, 4), generator=generator, dtype=torch.float64)
    maps = [depth_map(*batch)]
    Ks, motions = K + noise[..., 0, :3, :3], MOTIONS + 0.1 * noise
    if function is rigid_flow:
        maps.append(instance_map(*batch))
    else:
        motions = motions[..., 0, :, :]
    if function is factorize:
        maps.insert(0, raw_flow(*batch))
    for options in ({"dt": 0.5}, {"prev_K": PREV_K}):
        compute = partial(function, **options)
        for part in assert_equals_a_loop(compute, batch, *maps, Ks, motions):
            assert part.shape == (*batch, 1 if part.dtype == torch.bool else 2, HEIGHT, WIDTH)
    one_camera = function(*maps, K, motions)
    for part, other in zip(one_camera, function(*maps, K.expand_as(Ks), motions)):
        assert torch.equal(part, other)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_does_not_move_by_itself_has_exactly_no_object_flow(dtype):
    depth, camera = depth_map(2).to(dtype), K.to(dtype)
    depth[0, 0, 0, :2] = torch.tensor([INF, NAN])
    instance = torch.zeros_like(depth, dtype=torch.uint8)
    instance[..., 2:4, 3:6] = 1
    motions = torch.stack([MOTION, OTHER_MOTION]).to(dtype).expand(2, 2, 4, 4)
    raw, _ = rigid_flow(depth, instance, camera, motions)
    _, obj, _ = factorize(raw, depth, camera, motions[:, 0])
    static = (instance == 0).expand_as(obj)
    assert obj[static].abs().max() == 0
    assert obj[~static].abs().min() > 0
