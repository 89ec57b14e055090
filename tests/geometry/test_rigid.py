"""Rigid transforms: names cancel, and the relative motion survives a wide world."""

from itertools import product

import pytest
import torch

from flowrep.geometry import invert_rigid, relative_motion, transform_points
from tests.geometry.scenes import MOTION, OTHER_MOTION, rigid

QUARTER_TURN = torch.pi / 2


def test_transform_points_by_hand():
    # About z by a quarter turn, x goes to y: (1, 0, 0) -> (0, 1, 0), then + (10, 20, 30).
    a_from_b = rigid((0.0, 0.0, QUARTER_TURN), (10.0, 20.0, 30.0))
    points_a = transform_points(a_from_b, torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64))
    # The inverse rotation would give (10, 19, 30).
    torch.testing.assert_close(points_a[0].tolist(), [10.0, 21.0, 30.0])


@pytest.mark.parametrize("points", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("transform", [torch.float32, torch.float64])
def test_float_types_may_differ(transform, points):
    # Seen along z at 3 m by a camera 10.25 m along x that looks along world x.
    world_from_cam = torch.tensor([[0, 0, 1, 10.25], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    points_cam = torch.tensor([[0.5, 2.0, 3.0]], dtype=points)
    points_world = transform_points(world_from_cam.to(transform), points_cam)
    assert points_world.dtype == torch.promote_types(transform, points)
    assert points_world.tolist() == [[13.25, -0.5, -2.0]]


def test_invert_rigid_by_hand():
    a_from_b = rigid((0.0, 0.0, QUARTER_TURN), (10.0, 20.0, 30.0))
    # b's x axis is a's y axis: a's origin lies at -(20, -10, 30) in b. -t alone: (-10, -20, -30).
    torch.testing.assert_close(invert_rigid(a_from_b)[:3, 3].tolist(), [-20.0, 10.0, -30.0])


def test_inverse_undoes():
    undone = invert_rigid(MOTION) @ MOTION
    torch.testing.assert_close(undone, torch.eye(4, dtype=torch.float64))


def test_relative_motion_by_hand():
    # Both cameras look along world y (their z); the current one stands 2 m further on.
    world_from_prev = rigid((-QUARTER_TURN, 0.0, 0.0), (5.0, 1.0, 0.0))
    world_from_curr = rigid((-QUARTER_TURN, 0.0, 0.0), (5.0, 3.0, 0.0))
    prev_from_curr = relative_motion(world_from_prev, world_from_curr)
    # What the current camera sees 0 m ahead was 2 m ahead. curr_from_prev would have -2.
    torch.testing.assert_close(prev_from_curr[:3, 3].tolist(), [0.0, 0.0, 2.0])
    torch.testing.assert_close(prev_from_curr[:3, :3], torch.eye(3))


def test_relative_motion_is_the_product_of_poses():
    expected = torch.linalg.inv(MOTION) @ OTHER_MOTION
    got = relative_motion(MOTION, OTHER_MOTION, dtype=torch.float64)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_any_batch_equals_a_loop(batch):
    generator = torch.Generator().manual_seed(2)
    noise = torch.rand((*batch, 4, 4), generator=generator, dtype=torch.float64)
    poses = MOTION.expand(*batch, 4, 4).clone()
    poses[..., :3, 3] += noise[..., :3, 3]
    points = torch.rand((*batch, 2, 5, 3), generator=generator, dtype=torch.float64)
    relative = relative_motion(poses, OTHER_MOTION)
    assert relative.shape == (*batch, 4, 4)
    for at in product(*map(range, batch)):
        torch.testing.assert_close(relative[at], relative_motion(poses[at], OTHER_MOTION))
        torch.testing.assert_close(invert_rigid(poses)[at], invert_rigid(poses[at]))
        moved = transform_points(poses, points)[at]
        torch.testing.assert_close(moved, transform_points(poses[at], points[at]))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: invert_rigid(torch.eye(3)), ValueError, r"a_from_b must be \[\*B, 4, 4\]"),
        (
            lambda: relative_motion(torch.eye(4), torch.eye(4, dtype=torch.int64)),
            TypeError,
            "world_from_curr must be floating point",
        ),
        (
            lambda: relative_motion(torch.eye(4).expand(2, 4, 4), torch.eye(4).expand(3, 4, 4)),
            ValueError,
            r"world_from_prev \[2\], world_from_curr \[3\]",
        ),
        (
            lambda: transform_points(torch.eye(4).expand(2, 4, 4), torch.ones(3)),
            ValueError,
            "a_from_b has batch.*points_b",
        ),
    ],
)
def test_mistakes_are_named(call, error, message):
    with pytest.raises(error, match=message):
        call()
