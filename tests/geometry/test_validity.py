"""Where flow is valid it is finite, whatever goes in; where it isn't, it is 0 and sends back 0."""

import itertools
import math

import pytest
import torch

from flowrep.geometry import ego_flow, factorize, rigid_flow
from tests.geometry.scenes import HEIGHT, MOTION, OTHER_MOTION, WIDTH, K, depth_map

NAN, INF = math.nan, math.inf
ENTRIES = [
    *(("K", entry) for entry in itertools.product(range(3), range(3))),
    *(("motion", entry) for entry in itertools.product(range(4), range(4))),
    ("dt", ()),
]


def assert_nothing_is_known(flow: torch.Tensor, valid: torch.Tensor) -> None:
    assert not valid.any()
    assert flow.abs().max() == 0


def two_frames() -> dict[str, torch.Tensor]:
    """Returns the arguments of two frames, the second of which the tests leave as it is."""
    depth = depth_map(2)
    depth[..., 0, 0] = INF
    return {
        "depth": depth,
        "K": K.repeat(2, 1, 1),
        "motion": torch.stack([MOTION, OTHER_MOTION]),
        "dt": torch.tensor([0.5, 0.25]),
    }


@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize(("name", "entry"), ENTRIES)
def test_one_entry_that_is_not_finite_makes_its_frame_unknown(name, entry, value):
    given, sound = two_frames(), two_frames()
    given[name][(0, *entry)] = value
    leaves = [given[key].requires_grad_() for key in ("depth", "K", "motion")]
    flow, valid = ego_flow(*leaves, dt=given["dt"])
    assert_nothing_is_known(flow[0], valid[0])
    alone = ego_flow(*(sound[key][1] for key in ("depth", "K", "motion")), dt=sound["dt"][1])
    assert torch.equal(flow[1], alone.flow)
    assert valid[1].all()
    flow.square().sum().backward()
    for leaf in leaves:
        assert leaf.grad[0].abs().max() == 0  # nan fails this too
        assert leaf.grad[1].isfinite().all()


@pytest.mark.parametrize("dt", [0.0, -0.5, NAN, INF, -INF, 1e-40])
def test_a_time_that_does_not_run_forwards_makes_flow_unknown(dt):
    flow, valid = ego_flow(depth_map(2), K, MOTION, dt=torch.tensor([dt, 0.5]))
    assert_nothing_is_known(flow[0], valid[0])
    assert valid[1].all()
    if dt != 1e-40:
        with pytest.raises(ValueError, match="dt must be positive"):
            ego_flow(depth_map(), K, MOTION, dt=dt)


@pytest.mark.parametrize(("fx", "fy"), [(0.0, 6.0), (11.0, 0.0)])
def test_a_camera_without_focal_length_sees_nothing(fx, fy):
    camera = K.clone()
    camera[0, 0], camera[1, 1] = fx, fy
    camera.requires_grad_()
    flow, valid = ego_flow(depth_map(), camera, torch.eye(4))
    assert_nothing_is_known(flow, valid)
    flow.sum().backward()
    assert camera.grad.abs().max() == 0


def test_a_body_with_an_unknown_motion_leaves_the_others_alone():
    instance = torch.arange(HEIGHT * WIDTH).reshape(1, HEIGHT, WIDTH) % 3
    motions = torch.stack([MOTION, OTHER_MOTION, MOTION])
    sound = rigid_flow(depth_map(), instance, K, motions)
    motions = motions.clone()
    motions[1, 2, 3] = INF
    flow, valid = rigid_flow(depth_map(), instance, K, motions)
    assert torch.equal(valid, instance != 1)
    known = valid.expand_as(flow)
    assert torch.equal(flow[known], sound.flow[known])
    assert flow[~known].abs().max() == 0


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


def test_a_turn_of_nearly_a_right_angle_leaves_the_centre_unknown():
    # The optical axis lay 89.9 degrees off: its share of depth is cos(89.9) = 0.0017.
    turns = [math.radians(angle) for angle in (89.9, 89.0)]  # cos(89) = 0.0175
    motions = torch.eye(4).repeat(2, 1, 1)
    for motion, turn in zip(motions, turns):
        motion[0, 0] = motion[2, 2] = math.cos(turn)
        motion[0, 2], motion[2, 0] = math.sin(turn), -math.sin(turn)
    camera = torch.tensor([[4.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]])
    flow, valid = ego_flow(torch.full((1, 1, 1), INF), camera, motions)
    assert valid.flatten().tolist() == [False, True]
    assert flow[1, 0].item() == pytest.approx(-4.0 * math.tan(turns[1]), rel=1e-4)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_flow_is_finite_whatever_is_put_in(dtype):
    generator = torch.Generator().manual_seed(11)
    frames = 400

    def wild(*shape: int) -> torch.Tensor:
        """Returns numbers of every size, either sign, nan and inf."""
        sizes = 10 ** (100 * torch.rand(shape, generator=generator, dtype=torch.float64) - 50)
        signs = torch.randn(shape, generator=generator, dtype=torch.float64).sign()
        special = torch.tensor([NAN, INF, -INF, 0.0, 1.0], dtype=torch.float64)
        pick = torch.randint(0, 30, shape, generator=generator)
        return torch.where(pick < 5, special[pick.clamp(max=4)], sizes * signs)

    def some(tame: torch.Tensor, share: float) -> torch.Tensor:
        """Returns tame numbers of which a share has become wild."""
        mask = torch.rand(tame.shape, generator=generator) < share
        return torch.where(mask, wild(*tame.shape), tame).to(dtype)

    depth = some(depth_map(frames), 0.3)
    cameras, motions = (some(m.repeat(frames, 1, 1), 0.05) for m in (K, MOTION))
    raw = some(torch.ones(frames, 2, HEIGHT, WIDTH, dtype=torch.float64), 0.2)
    dt = some(torch.ones(frames, dtype=torch.float64), 0.3)
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


@pytest.mark.parametrize(
    ("raw", "others", "expected"),
    [
        (torch.float64, torch.float32, torch.float64),
        (torch.float32, torch.float64, torch.float64),
        (torch.bfloat16, torch.float32, torch.float32),
        (torch.float16, torch.bfloat16, torch.float32),
    ],
)
def test_factors_have_one_type_the_widest(raw, others, expected):
    flow = rigid_flow(
        depth_map().to(others),
        torch.zeros(1, HEIGHT, WIDTH, dtype=torch.uint8),
        K.to(others),
        MOTION.to(others)[None],
    ).flow
    geometry = [tensor.to(others) for tensor in (depth_map(), K, MOTION)]
    ego, obj, valid = factorize(flow.to(raw), *geometry)
    assert ego.dtype == obj.dtype == expected
    assert valid.all()
    if torch.promote_types(raw, others) == raw:  # widened raw flow rounds as ego flow does
        assert obj.abs().max() == 0
