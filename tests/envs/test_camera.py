"""A street's camera: its intrinsics and its mount; tests/test_pybullet.py measures K."""

import math

import numpy as np
import pytest

from flowrep.scenes.scene import CameraConfig

NEAR_M, FAR_M = 0.2, 300.0


def test_the_focal_length_follows_the_vertical_field_of_view():
    # Half of 48 rows over tan(30°): 24 / 0.57735 = 41.569; the width plays no part.
    camera = CameraConfig(48, 100, 60.0, 1.5, 0.0, 0.0, NEAR_M, FAR_M)
    assert camera.focal_px == pytest.approx(24 * math.sqrt(3))
    # The principal point is half a pixel right of the middle and above it, as
    # PyBullet samples.
    f = camera.focal_px
    np.testing.assert_array_equal(camera.K, [[f, 0, 50.5], [0, f, 23.5], [0, 0, 1]])


def test_the_mount_points_the_camera_forward_and_pitches_it_up():
    camera = CameraConfig(48, 48, 90.0, 1.5, 0.4, 30.0, NEAR_M, FAR_M)
    mount = camera.vehicle_from_cam
    # A point 2 m ahead of the camera: 30° upwards is +1 m of height and 1.732 m forward.
    ahead = mount @ [0.0, 0.0, 2.0, 1.0]
    np.testing.assert_allclose(ahead, [0.4 + math.sqrt(3), 0.0, 2.5, 1.0], atol=1e-12)
    # The camera's right is the vehicle's -y (y points left).
    np.testing.assert_allclose(mount @ [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(mount[:3, :3].T @ mount[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(mount[:3, :3]) == pytest.approx(1.0)
