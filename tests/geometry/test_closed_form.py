"""What the closed form promises: finite flow, finite gradients, float32 near float64."""

import itertools
import math

import pytest
import torch
from torch.autograd import gradcheck

from flowrep.geometry import ego_flow, factorize, rigid_flow
from tests.geometry.scenes import (
    HEIGHT,
    MOTION,
    OTHER_MOTION,
    WIDTH,
    K,
    depth_map,
    flow_pixel_by_pixel,
    raw_flow,
    rigid,
    spoilt,
)

NAN, INF = math.nan, math.inf


SPOILT = [
    *(("K", at, bad) for at in itertools.product(range(3), range(3)) for bad in (NAN, -INF)),
    *(("motion", at, bad) for at in itertools.product(range(4), range(4)) for bad in (NAN, -INF)),
    *(("dt", (), bad) for bad in (0.0, -0.5, NAN, INF, -INF, 1e-40)),
    *(("K", at, 0.0) for at in ((0, 0), (1, 1))),  # no focal length
    *(("prev_K", at, bad) for at in ((0, 0), (0, 1), (1, 2)) for bad in (NAN, INF, 1e9)),
    *(("prev_K", at, 0.0) for at in ((0, 0), (1, 1))),
]


@pytest.mark.parametrize(("name", "entry", "value"), SPOILT)
def test_one_impossible_entry_makes_its_frame_unknown_and_no_other(name, entry, value):
    depth = depth_map(2)
    depth[..., 0, 0] = INF
    given = {"depth": depth, "K": K.repeat(2, 1, 1), "motion": torch.stack([MOTION, OTHER_MOTION])}
    given["dt"] = torch.tensor([0.5, 0.25])
    given["prev_K"] = 1.1 * given["K"]
    names = ("depth", "K", "motion")
    zoom = {} if name != "prev_K" else {"prev_K": given["prev_K"]}
    zoomed = {key: prev_K[1].clone() for key, prev_K in zoom.items()}
    alone = ego_flow(*(given[key][1] for key in names), dt=0.25, **zoomed)
    given[name][(0, *entry)] = value
    leaves = [given[key].requires_grad_() for key in (*names, *zoom)]
    flow, valid = ego_flow(*leaves[:3], dt=given["dt"], **zoom)
    assert not valid[0].any()
    assert flow[0].abs().max() == 0
    assert torch.equal(flow[1], alone.flow)
    assert valid[1].all()
    flow.square().sum().backward()
    for leaf in leaves:
        assert leaf.grad[0].abs().max() == 0  # nan fails this too
        assert leaf.grad[1].isfinite().all()


def test_a_point_close_before_the_previous_camera_is_invalid_by_hand():
    # The camera backed off by 2 m: what is now Z ahead was Z - 2 ahead, a share 1 - 2 / Z of it.
    # A hundredth at Z = 200/99 = 2.0202...; the pixel at x = 1.5 was at 1.5 / (1 - 2 / Z).
    camera = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]])
    backed_off = torch.eye(4)
    backed_off[2, 3] = -2.0
    depth = torch.tensor([2.0 + 1e-6, 2.02, 2.021, 4.0]).reshape(4, 1, 1, 1).expand(4, 1, 1, 3)
    flow, valid = ego_flow(depth, camera, backed_off)
    assert valid[:, 0, 0, 2].tolist() == [False, False, True, True]
    u = flow[:, 0, 0, 2].tolist()
    assert u[:2] == [0.0, 0.0]  # unmasked, 3 million and 150 px
    assert u[2] == pytest.approx(1.5 - 1.5 / (1 - 2 / 2.021), rel=1e-3)  # -142.9 px
    assert u[3] == -1.5


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_flow_is_finite_whatever_is_put_in(dtype):
    generator, frames = torch.Generator().manual_seed(11), 400
    given = (
        (depth_map(frames), 0.3),
        *((m.repeat(frames, 1, 1), 0.05) for m in (K, MOTION)),
        (torch.ones(frames, 2, HEIGHT, WIDTH).double(), 0.2),
        (torch.ones(frames).double(), 0.3),
    )
    depth, cameras, motions, raw, dt = (
        spoilt(tame, share, generator).to(dtype) for tame, share in given
    )
    ego, obj, valid = factorize(raw, depth, cameras, motions, dt=dt)
    alone = ego_flow(depth, cameras, motions, dt=dt)
    for flow in (ego, obj, alone.flow):
        assert flow.dtype == dtype
        assert flow.isfinite().all()
    assert obj[~valid.expand_as(obj)].abs().max() == 0
    assert ego[~alone.valid.expand_as(ego)].abs().max() == 0
    assert 0.02 < valid.float().mean() < 0.5  # it isn't just all refused
    assert (depth[alone.valid] > 0).all()


def test_flow_that_float16_can_not_hold_is_unknown_and_a_large_sum_is_not():
    # 100 px / 0.001 s = 100,000 px/s, past 65,504; 40 px give 40,000 in each channel.
    camera = torch.tensor([[100.0, 0.0, 0.5], [0.0, 100.0, 0.5], [0.0, 0.0, 1.0]]).half()
    motions = torch.eye(4).repeat(2, 1, 1).half()
    motions[0, 0, 3], motions[1, 0, 3], motions[1, 1, 3] = -1.0, -0.4, -0.4
    depth = torch.ones(2, 1, 1, 1).half()
    flow, valid = ego_flow(depth, camera, motions, dt=0.001)
    assert valid.flatten().tolist() == [False, True]
    assert flow[0].abs().max() == 0
    raw = torch.zeros(2, 2, 1, 1).half()
    _, obj, valid = factorize(raw, depth, camera, motions, dt=0.001)
    assert valid.flatten().tolist() == [False, True]
    torch.testing.assert_close(obj[1].flatten().float(), torch.full((2,), -4e4), rtol=1e-3, atol=0)


def depth_with_every_mask() -> torch.Tensor:
    depth = depth_map()[:, :2]  # two rows are enough
    depth[0, 0, :5] = torch.tensor([math.inf, math.nan, 0.0, -2.0, -math.inf])
    depth[0, 0, 5] = 1.5  # behind the previous camera of BACKED_OFF
    return depth.requires_grad_()


BACKED_OFF = MOTION.clone()
BACKED_OFF[2, 3] = -2.0


def leaves(*tensors: torch.Tensor) -> list[torch.Tensor]:
    return [tensor.clone().requires_grad_() for tensor in tensors]


@pytest.mark.parametrize("function", [ego_flow, rigid_flow, factorize])
def test_gradients(function):
    depth, raw = depth_with_every_mask(), raw_flow()[:, :2]
    raw[0, 1, 2] = math.nan
    camera, motions = leaves(K, torch.stack([BACKED_OFF, OTHER_MOTION]))
    raw.requires_grad_(function is factorize)
    prev_camera = (K + 0.3 * K.triu()).requires_grad_()
    instance = torch.arange(2 * WIDTH).reshape(1, 2, WIDTH) % 2

    def flow(raw, depth, camera, motions, prev_K):
        if function is rigid_flow:
            return rigid_flow(depth, instance, camera, motions, prev_K=prev_K).flow
        if function is ego_flow:
            return ego_flow(depth, camera, motions[0], prev_K=prev_K, dt=0.5).flow
        return factorize(raw, depth, camera, motions[0], prev_K=prev_K)[:2]

    valid = ego_flow(depth, K, BACKED_OFF).valid
    assert valid[0, 0].tolist() == [True] + 5 * [False] + [True]
    assert gradcheck(flow, (raw, depth, camera, motions, None))
    assert gradcheck(flow, (raw, depth, camera, motions, prev_camera))


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


SIZE = 84


def street(yaw_deg: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns depth, K and motion of a camera at 10 m/s and 12 frames/s, float32."""
    generator = torch.Generator().manual_seed(8)
    depth = 2 + 60 * torch.rand((1, SIZE, SIZE), generator=generator)
    camera = torch.tensor([[42.0, 0.0, 42.0], [0.0, 42.0, 42.0], [0.0, 0.0, 1.0]])
    return depth, camera, rigid((0.0, math.radians(yaw_deg), 0.01), (0.02, 0.01, 0.83)).float()


@pytest.mark.parametrize("yaw_deg", [0.0, 1.0, 3.0, 6.0])
def test_float32_error_is_an_order_of_magnitude_below_the_homography_s(yaw_deg):
    inputs = street(yaw_deg)
    exact = flow_pixel_by_pixel(*(tensor.double() for tensor in inputs))
    # px; flow itself reaches 16. By the homography K R K^-1, p - p' is over five times as far off.
    assert (ego_flow(*inputs).flow - exact).abs().max() < 4e-6


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_narrow_types_are_computed_in_float32_and_rounded_once(dtype):
    inputs = [tensor.to(dtype) for tensor in street(2.0)]
    wide = [tensor.float() for tensor in inputs]
    assert torch.equal(ego_flow(*inputs).flow, ego_flow(*wide).flow.to(dtype))


def test_the_result_has_the_widest_type_and_static_pixels_no_object_flow_in_any():
    depth, camera, motion = street(1.0)
    instance = torch.zeros_like(depth, dtype=torch.int32)
    assert ego_flow(depth, camera, motion.double()).flow.dtype == torch.float64
    f16, bf16, f32, f64 = torch.float16, torch.bfloat16, torch.float32, torch.float64
    for raw, others in [(f64, f32), (f32, f64), (bf16, f32), (f16, bf16), (f16, f16)]:
        given = [tensor.to(others) for tensor in (depth, camera, motion)]
        flow = rigid_flow(given[0], instance, given[1], given[2][None]).flow
        ego, obj, valid = factorize(flow.to(raw), *given)
        widest = torch.promote_types(raw, others)
        assert ego.dtype == obj.dtype == widest
        assert valid.all()
        if widest == raw:  # widened raw flow rounds as ego flow does
            assert obj.abs().max() == 0
