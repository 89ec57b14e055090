"""Each wrong convention is found and named; right ones are left in peace."""

from __future__ import annotations

import dataclasses

import pytest
import torch

pytest.importorskip("cv2", reason="recordings need OpenCV")

from flowrep.geometry import (
    adapt_pose,
    ego_flow,
    invert_rigid,
    relative_motion,
    rigid_flow,
    z_from_ray_length,
)
from flowrep.sequences import Doctor, diagnose
from flowrep.sequences.doctor import MISTAKES
from tests.geometry.scenes import rigid

HEIGHT, WIDTH = 45, 64
K = torch.tensor([[40.0, 0.0, 30.5], [0.0, 37.0, 24.0], [0.0, 0.0, 1.0]])
BEFORE = rigid((0.4, -0.7, 1.1), (3.0, -2.0, 5.0))
NOW = BEFORE @ rigid((0.01, -0.02, 0.015), (0.15, -0.05, 0.2))


@dataclasses.dataclass(frozen=True)
class Case:
    """What the doctor is told."""

    raw: torch.Tensor
    depth: torch.Tensor
    before: torch.Tensor = BEFORE
    now: torch.Tensor = NOW

    def diagnosis(self, **options):
        return diagnose(self.raw, self.depth, K, self.before, self.now, **options)


@pytest.fixture
def right():
    """A slope with a rough surface, a quarter of which moves by itself."""
    rough = torch.rand(1, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    depth = torch.linspace(2, 9, HEIGHT)[None, :, None] + rough
    instance = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.uint8)
    instance[0, 20:42, 5:38] = 1
    camera = relative_motion(BEFORE, NOW)
    motions = torch.stack([camera, camera @ rigid((0.0, 0.0, 0.0), (0.3, 0.1, 0.0)).float()])
    return Case(rigid_flow(depth, instance, K, motions).flow, depth)


def poses(case, change):
    return dataclasses.replace(case, before=change(BEFORE), now=change(NOW))


OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
# The columns are OpenCV's right, down and forward in north-east-down axes.
NED = torch.tensor([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)

WRONG = {
    "poses_inverted": lambda case: poses(case, invert_rigid),
    "flow_sign": lambda case: dataclasses.replace(case, raw=-case.raw),
    "flow_channels": lambda case: dataclasses.replace(case, raw=case.raw.flip(0)),
    "axes_opengl": lambda case: poses(case, lambda pose: pose @ OPENGL),
    "axes_ned": lambda case: poses(case, lambda pose: pose @ NED.mT),
    "axes_not_ned": lambda case: poses(case, lambda pose: adapt_pose(pose, axes="ned")),
    "axes_not_x_forward": lambda case: poses(
        case, lambda pose: adapt_pose(pose, axes="x_forward_z_up")
    ),
    "poses_inverted_opengl": lambda case: poses(case, lambda pose: invert_rigid(pose @ OPENGL)),
    "ray_length": lambda case: dataclasses.replace(case, depth=ray_length(case.depth)),
    "not_ray_length": lambda case: dataclasses.replace(
        case, depth=z_from_ray_length(case.depth, K)
    ),
    "depth_times_0.001": lambda case: dataclasses.replace(case, depth=1000 * case.depth),
    "depth_times_1000": lambda case: dataclasses.replace(case, depth=case.depth / 1000),
    "depth_times_0.2": lambda case: dataclasses.replace(case, depth=5 * case.depth),
    "depth_times_5": lambda case: dataclasses.replace(case, depth=case.depth / 5),
}


def ray_length(depth):
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    x, y = (u - 30.5) / 40, (v - 24.0) / 37
    return depth * (1 + x**2 + y**2).sqrt()


def test_right_conventions_are_left_in_peace(right):
    found = right.diagnosis()
    assert found.suspects == ()
    assert found.residual_px < 1e-3 < found.raw_px
    assert found.words.startswith("conventions look right: |raw - ego| is 0.00 px, raw flow ")


@pytest.mark.parametrize("mistake", WRONG)
def test_a_wrong_convention_is_named(mistake, right):
    found = WRONG[mistake](right).diagnosis()
    assert found.suspects[0] == mistake
    assert found.rivals_px[mistake] < 1e-3
    assert found.residual_px > 0.1
    assert found.words.startswith("a convention looks wrong:")


def test_the_sky_is_at_infinity_as_either_kind_of_depth():
    depth = torch.full((1, HEIGHT, WIDTH), torch.inf)
    depth[0, 30, 50] = 2.0
    for mistake, expected in (
        ("ray_length", 4.0 / float(ray_length(depth)[0, 30, 50])),
        ("not_ray_length", float(ray_length(depth)[0, 30, 50])),
    ):
        corrected = MISTAKES[mistake].depth(depth, K)
        assert corrected.isinf().sum() == HEIGHT * WIDTH - 1
        assert corrected[0, 30, 50].item() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("mistake", "option"),
    [
        ("poses_inverted", "format.pose_direction=world_to_camera"),
        ("flow_sign", "format.flow_direction=backward"),
        ("axes_opengl", "format.pose_axes=opengl"),
        ("axes_ned", "format.pose_axes=ned"),
        ("ray_length", "format.depth_kind=ray_length"),
        ("depth_times_0.2", "format.depth_unit_m times 0.2"),
    ],
)
def test_the_words_name_the_option(mistake, option, right):
    assert option in WRONG[mistake](right).diagnosis().words


@pytest.mark.parametrize("mistake", ["flow_sign", "poses_inverted", "axes_opengl"])
def test_it_is_found_in_noisy_flow_too(mistake, right):
    noise = torch.randn(right.raw.shape, generator=torch.Generator().manual_seed(1))
    noisy = dataclasses.replace(right, raw=right.raw + 0.3 * noise)
    assert noisy.diagnosis().suspects == ()
    assert WRONG[mistake](noisy).diagnosis().suspects[0] == mistake


def test_where_most_moves_what_stands_still_can_be_told(right):
    moving = right.raw.clone()
    moving[:, :, :50] += torch.tensor([3.0, -2.0]).reshape(2, 1, 1)
    crowd = dataclasses.replace(right, raw=moving)
    static = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    static[..., 52:] = True
    assert crowd.diagnosis().residual_px > 1
    assert crowd.diagnosis(static=static).residual_px < 1e-3


def test_unknown_flow_and_missing_depth_are_left_out(right):
    raw, depth = right.raw.clone(), right.depth.clone()
    raw[:, :, ::2] = torch.nan
    depth[:, ::2] = torch.nan
    assert dataclasses.replace(right, raw=raw, depth=depth).diagnosis().suspects == ()


def test_what_no_mistake_explains_is_said_too(right):
    raw = 5 * torch.randn(right.raw.shape, generator=torch.Generator().manual_seed(2))
    found = dataclasses.replace(right, raw=raw).diagnosis()
    assert found.suspects == ()
    assert found.words.startswith("ego flow does not explain the raw flow")


def test_a_camera_that_stands_still_tells_nothing(right):
    still = dataclasses.replace(right, raw=torch.zeros_like(right.raw), now=BEFORE)
    found = still.diagnosis()
    assert found.pairs == 0
    assert "hardly anything moves" in found.words


def test_several_pairs_are_weighed_together(right):
    doctor = Doctor()
    for mistake in ("flow_sign", "flow_sign", "axes_opengl"):
        case = WRONG[mistake](right)
        doctor.look(case.raw, case.depth, K, case.before, case.now)
    found = doctor.diagnosis()
    assert found.pairs == 3
    assert found.suspects[0] == "flow_sign"


def test_large_pictures_are_sampled_without_a_shift():
    # A coarse grid with K off by half a step would leave pixels over.
    height, width = 480, 639
    camera = torch.tensor([[500.0, 0, 310.0], [0, 480.0, 250.0], [0, 0, 1]])
    rows, columns = torch.arange(height)[:, None], torch.arange(width)
    depth = (1.5 + 0.01 * rows + 0.004 * columns)[None]
    raw, _ = ego_flow(depth, camera, relative_motion(BEFORE, NOW))
    found = diagnose(raw, depth, camera, BEFORE, NOW)
    assert found.raw_px == pytest.approx(float(raw.norm(dim=0).median()), rel=0.02)
    assert found.residual_px < 1e-3
