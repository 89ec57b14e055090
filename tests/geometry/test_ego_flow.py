"""Ego flow: values by hand, agreement with the point-cloud way, masks, units, laws, mistakes."""

import math
from itertools import product

import pytest
import torch

from flowrep.geometry import ego_flow
from tests.geometry.scenes import HEIGHT, MOTION, WIDTH, K, depth_map, flow_by_points, rigid

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


def test_skew_by_hand():
    # Moving 0.25 m down with skew 2 shifts u as well: -2 * 0.25/4, where ignored skew gives 0.
    flow, _ = ego_flow(torch.full((1, 1, 1), 4.0), camera(skew=2.0), moved(y=0.25))
    assert flow.flatten().tolist() == [-0.125, -0.5]


def test_quarter_turn_about_the_axis_by_hand():
    # prev_from_curr turns x to y: pixel (1, 0) at (0.5, 0.25) px has ray (1/8, 1/32), which was
    # (-1/32, 1/8), at (-1/8, 1) px. Flow (0.5 + 0.125, 0.25 - 1); the inverse turn gives
    # (0.375, 1.25); square pixels (f = 4) would give (0.75, -0.25).
    roll = rigid((0.0, 0.0, math.pi / 2), (0.0, 0.0, 0.0)).float()
    flow, _ = ego_flow(torch.full((1, 1, 2), 7.0), camera(), roll)
    torch.testing.assert_close(flow[:, 0, 1].tolist(), [0.625, -0.75])


@pytest.mark.parametrize("motion", [MOTION, rigid((0.4, -0.3, 0.9), (-1.0, 0.5, 1.5))])
def test_agrees_with_the_point_cloud(motion):
    depth = depth_map()
    flow, valid = ego_flow(depth, K, motion)
    assert valid.all()
    torch.testing.assert_close(flow, flow_by_points(depth, K, motion), rtol=0, atol=1e-12)


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


def test_points_that_were_behind_the_previous_camera_are_invalid():
    # The camera backed off by 2 m: what is now 1 m or 2 m ahead was behind it or level with it.
    flow, valid = ego_flow(torch.tensor([[[1.0, 2.0, 3.0]]]), camera(), moved(z=-2.0))
    assert valid.tolist() == [[[False, False, True]]]
    assert flow[..., :2].abs().max() == 0  # unmasked, the first would be mirrored, the second inf


def test_rotation_turns_a_far_pixel_out_of_the_previous_view():
    about_face = rigid((0.0, math.pi, 0.0), (0.0, 0.0, 0.0)).float()
    assert not ego_flow(torch.tensor([[[INF, 5.0]]]), camera(), about_face).valid.any()


def test_unknown_motion_gives_no_nan():
    motion = torch.eye(4)
    motion[:3] = NAN
    flow, valid = ego_flow(torch.full((1, 2, 3), 4.0), camera(), motion)
    assert not valid.any()
    assert flow.abs().max() == 0


def test_still_camera_sees_exactly_no_flow():
    depth = depth_map().float()
    depth[..., 0, 0] = INF
    flow, valid = ego_flow(depth, K.float(), torch.eye(4))
    assert valid.all()
    assert flow.abs().max() == 0


def test_flow_is_per_step_unless_told_seconds():
    depth = depth_map()
    per_step = ego_flow(depth, K, MOTION).flow
    per_second = ego_flow(depth, K, MOTION, dt=0.125).flow
    torch.testing.assert_close(per_second, 8 * per_step, rtol=1e-14, atol=0)


def test_each_frame_may_have_its_own_dt():
    depth = depth_map(2)
    flow, _ = ego_flow(depth, K, MOTION, dt=torch.tensor([0.5, 4.0]))
    torch.testing.assert_close(flow[0], 2 * ego_flow(depth[0], K, MOTION).flow)
    torch.testing.assert_close(flow[1], ego_flow(depth[1], K, MOTION).flow / 4)


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_any_batch_equals_a_loop(batch):
    generator = torch.Generator().manual_seed(3)
    noise = torch.rand((*batch, 4, 4), generator=generator, dtype=torch.float64)
    Ks, motions, depth = K + noise[..., :3, :3], MOTION + 0.1 * noise, depth_map(*batch)
    flow, valid = ego_flow(depth, Ks, motions)
    assert flow.shape == (*batch, 2, HEIGHT, WIDTH)
    assert valid.shape == (*batch, 1, HEIGHT, WIDTH)
    assert valid.dtype == torch.bool
    for at in product(*map(range, batch)):
        assert torch.equal(flow[at], ego_flow(depth[at], Ks[at], motions[at]).flow)
    unbatched_K = ego_flow(depth, K, motions).flow
    assert torch.equal(unbatched_K, ego_flow(depth, K.expand(*batch, 3, 3), motions).flow)


def test_one_depth_under_many_motions():
    motions = torch.stack([MOTION, torch.eye(4, dtype=torch.float64)])
    flow, valid = ego_flow(depth_map(), K, motions)
    assert flow.shape == (2, 2, HEIGHT, WIDTH)
    assert valid.shape == (2, 1, HEIGHT, WIDTH)
    assert torch.equal(flow[0], ego_flow(depth_map(), K, MOTION).flow)


def test_layout_in_memory_does_not_matter():
    depth = depth_map(3)
    transposed = depth.mT.contiguous().mT
    assert torch.equal(ego_flow(transposed, K, MOTION).flow, ego_flow(depth, K, MOTION).flow)


def test_inputs_stay_as_they_were():
    given = [depth_map(), K.clone(), MOTION.clone()]
    given[0][..., 0, 0] = NAN
    before = [tensor.clone() for tensor in given]
    ego_flow(*given)
    for tensor, copy in zip(given, before):
        torch.testing.assert_close(tensor, copy, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda d, m: ego_flow(d[0], K, m), ValueError, r"depth must be \[\*B, 1, H, W\]"),
        (lambda d, m: ego_flow(d.expand(2, -1, -1), K, m), ValueError, r"depth .* got \[2, 5, 7\]"),
        (lambda d, m: ego_flow(d, K[:2], m), ValueError, r"K must be \[\*B, 3, 3\], got \[2, 3\]"),
        (lambda d, m: ego_flow(d, K, m[:3]), ValueError, r"prev_from_curr must be \[\*B, 4, 4\]"),
        (lambda d, m: ego_flow(d, K, m.numpy()), TypeError, "prev_from_curr must be a torch.Tens"),
        (lambda d, m: ego_flow(d.int(), K, m), TypeError, "depth must be floating point"),
        (
            lambda d, m: ego_flow(d.expand(2, 1, 5, 7), K, m.expand(3, 4, 4)),
            ValueError,
            r"do not broadcast: depth \[2\], K \[\], prev_from_curr \[3\]",
        ),
        (lambda d, m: ego_flow(d, K, m, dt=0), ValueError, "dt must be positive .* got 0"),
        (lambda d, m: ego_flow(d, K, m, dt=-1.0), ValueError, r"dt must be positive .* got -1\.0"),
    ],
)
def test_mistakes_are_named(call, error, message):
    with pytest.raises(error, match=message):
        call(depth_map(), MOTION)
