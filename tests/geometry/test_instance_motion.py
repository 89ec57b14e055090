"""Poses of bodies to what their motion is to a camera."""

import math

import pytest
import torch

from flowrep.geometry import (
    check_rigid,
    instance_motion,
    invert_rigid,
    relative_motion,
    transform_points,
)
from tests.geometry.scenes import MOTION, OTHER_MOTION, rigid

PREV, CURR = rigid((0.1, 0.2, 0.3), (400.0, -300.0, 1.2)), rigid((0.1, 0.25, 0.3), (400.8, -300, 1))
BODY_BEFORE = torch.stack([MOTION, OTHER_MOTION])
BODY_NOW = torch.stack([MOTION, rigid((0.4, 0.0, -0.1), (2.0, 3.0, 4.0))])


def test_by_hand():
    # The camera stands at the origin and looks along z. The body went 2 m to the right and turned
    # by a quarter about y (forward to right): its nose, 1 m ahead of it, is at (2 + 1, 0, 5) now
    # and was at (0, 0, 5 + 1).
    still, before = torch.eye(4), torch.eye(4)
    before[2, 3] = 5.0
    now = torch.tensor([[0.0, 0, 1, 2], [0, 1, 0, 0], [-1, 0, 0, 5], [0, 0, 0, 1]])
    motions = instance_motion(still, still, before[None], now[None])
    assert torch.equal(motions[0], torch.eye(4))
    assert transform_points(motions[1], torch.tensor([3.0, 0.0, 5.0])).tolist() == [0.0, 0.0, 6.0]


def test_a_point_on_a_body_goes_where_it_was():
    motions = instance_motion(PREV, CURR, BODY_BEFORE, BODY_NOW, dtype=torch.float64)
    point_body = torch.tensor([0.3, -0.2, 0.7], dtype=torch.float64)
    curr_from_body = invert_rigid(CURR) @ BODY_NOW[1]
    prev_from_body = invert_rigid(PREV) @ BODY_BEFORE[1]
    was = transform_points(motions[2], transform_points(curr_from_body, point_body))
    torch.testing.assert_close(was, transform_points(prev_from_body, point_body))


def test_a_body_that_stands_still_has_the_camera_s_motion_to_the_last_bit():
    far = BODY_NOW.clone()
    far[:, :3, 3] += 1000.0 / 3.0
    motions = instance_motion(PREV, CURR, far, far)
    assert motions.dtype == torch.float32
    assert torch.equal(motions, relative_motion(PREV, CURR).expand(3, 4, 4))
    # In float64 no rounding hides that the bodies' rows went another way.
    exact = instance_motion(PREV, CURR, far, far, dtype=torch.float64)
    camera = relative_motion(PREV, CURR, dtype=torch.float64)
    assert torch.equal(exact, camera.expand(3, 4, 4))


def test_a_batch_equals_a_loop():
    prev, curr = PREV.repeat(2, 1, 1, 1), torch.stack([CURR, PREV]).unsqueeze(1)
    together = instance_motion(prev, curr, BODY_BEFORE, BODY_NOW)
    assert together.shape == (2, 1, 3, 4, 4)
    for i in range(2):
        alone = instance_motion(prev[i, 0], curr[i, 0], BODY_BEFORE, BODY_NOW)
        torch.testing.assert_close(together[i, 0], alone)


def test_no_bodies_leave_the_static_world():
    motions = instance_motion(PREV, CURR, BODY_NOW[:0], BODY_NOW[:0])
    assert torch.equal(motions, relative_motion(PREV, CURR)[None])


def test_another_number_of_bodies_is_refused():
    with pytest.raises(ValueError, match="the same bodies are needed before and now, got 2 and 1"):
        instance_motion(PREV, CURR, BODY_BEFORE, BODY_NOW[:1])


def test_equal_poses_are_exactly_no_motion():
    # R R^T of this rotation is not the identity in floats.
    assert torch.equal(relative_motion(PREV, PREV), torch.eye(4))
    both = relative_motion(torch.stack([PREV, PREV]), torch.stack([PREV, CURR]))
    assert torch.equal(both[0], torch.eye(4))
    assert not torch.equal(both[1], torch.eye(4))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_rigid_transform_passes(dtype):
    check_rigid("pose", PREV.to(dtype))


def test_the_offender_is_shown():
    poses = torch.stack([PREV, PREV])
    poses[1, 0, 0] = math.inf
    with pytest.raises(ValueError, match=r"pose\[1\] holds nan or inf; got \[\[inf"):
        check_rigid("pose", poses)
