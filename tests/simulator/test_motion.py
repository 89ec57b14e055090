"""Relative motion against points that are carried along by hand."""

import math

import numpy as np

from flowrep.scenes.scene import CameraConfig
from flowrep.simulator.camera import vehicle_from_camera
from flowrep.simulator.motion import instance_motion, planar, relative_motion, rigid_inverse

MOUNT = vehicle_from_camera(CameraConfig(48, 60, 70.0, 1.5, 0.4, -10.0, 0.2, 100.0))
BEFORE = planar(3.0, -1.0, 0.3) @ MOUNT
NOW = planar(3.8, -0.7, 0.42) @ MOUNT
PREV_BODIES = np.stack([planar(10.0, 2.0, 0.1), planar(12.0, -3.0, 1.0), planar(8.0, 0.0, 3.0)])
BODIES = np.stack([planar(10.1, 2.2, 0.4), planar(12.0, -3.0, 1.0), planar(7.9, 0.0, 3.0)])


def test_a_camera_that_stands_moves_by_the_exact_identity():
    again = planar(3.8, -0.7, 0.42) @ MOUNT
    assert np.array_equal(relative_motion(NOW, again), np.eye(4))
    assert np.array_equal(
        instance_motion(NOW, again, BODIES, BODIES), np.tile(np.eye(4), (4, 1, 1))
    )


def test_a_point_on_a_body_is_carried_back_with_it():
    rows = instance_motion(BEFORE, NOW, PREV_BODIES, BODIES)
    on_body = np.array([0.2, -0.3, 1.6, 1.0])
    for i, (prev, body) in enumerate(zip(PREV_BODIES, BODIES)):
        seen_now = rigid_inverse(NOW) @ body @ on_body
        seen_before = rigid_inverse(BEFORE) @ prev @ on_body
        np.testing.assert_allclose(rows[1 + i] @ seen_now, seen_before, atol=1e-12)


def test_a_body_that_stands_has_row_zeros_very_numbers():
    rows = instance_motion(BEFORE, NOW, PREV_BODIES, BODIES)
    assert np.array_equal(rows[0], relative_motion(BEFORE, NOW))
    assert np.array_equal(rows[2], rows[0])
    assert not np.allclose(rows[1], rows[0])
    assert not np.allclose(rows[3], rows[0])


def test_a_body_turns_about_itself_and_not_the_origin():
    # A quarter turn to the left on the spot: what is 1 m ahead at (5, 1) was at (6, 0).
    prev, now = planar(5.0, 0.0, 0.0)[None], planar(5.0, 0.0, math.pi / 2)[None]
    row = instance_motion(NOW, NOW, prev, now)[1]
    seen_now = rigid_inverse(NOW) @ [5.0, 1.0, 0.7, 1.0]
    expected = rigid_inverse(NOW) @ [6.0, 0.0, 0.7, 1.0]
    np.testing.assert_allclose(row @ seen_now, expected, atol=1e-12)


def test_motion_far_from_the_origin_is_as_exact():
    before, now = (planar(10_000.0 + x, 10_000.0, 0.3) @ MOUNT for x in (0.0, 0.8))
    expected = relative_motion(planar(0.0, 0.0, 0.3) @ MOUNT, planar(0.8, 0.0, 0.3) @ MOUNT)
    np.testing.assert_allclose(relative_motion(before, now), expected, atol=1e-11)
