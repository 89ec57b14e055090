"""The camera of a street: its K, its mount, and what the depth buffer means.

That pictures are sampled at this K is tested with `BulletCamera`, and that both renderers agree.
"""

import math

import numpy as np
import pytest

from flowrep.scenes.scene import CameraConfig
from flowrep.simulator.camera import depth_from_zbuffer, vehicle_from_camera

NEAR_M, FAR_M = 0.2, 300.0


def test_depth_buffer_ends_are_near_and_far():
    # OpenGL: 0 is the near plane, 1 the far one; 0.5 of near 1, far 3 is 3 / (3 - 2 * 0.5) = 1.5.
    depth = depth_from_zbuffer(np.array([0.0, 0.5, 1.0], dtype=np.float32), 1.0, 3.0)
    np.testing.assert_allclose(depth, [1.0, 1.5, 3.0], rtol=1e-6)
    assert depth.dtype == np.float32


def test_the_focal_length_follows_the_vertical_field_of_view():
    # Half of 48 rows over tan(30°): 24 / 0.57735 = 41.569; the width plays no part.
    camera = CameraConfig(48, 100, 60.0, 1.5, 0.0, 0.0, NEAR_M, FAR_M)
    assert camera.focal_px == pytest.approx(24 * math.sqrt(3))
    # cx, cy are half a pixel right of the middle and above it: see PRINCIPAL_POINT_SHIFT_PX.
    f = camera.focal_px
    np.testing.assert_array_equal(camera.K, [[f, 0, 50.5], [0, f, 23.5], [0, 0, 1]])


def test_the_mount_points_the_camera_forward_and_pitches_it_up():
    camera = CameraConfig(48, 48, 90.0, 1.5, 0.4, 30.0, NEAR_M, FAR_M)
    mount = vehicle_from_camera(camera)
    # A point 2 m ahead of the camera: 30° upwards is +1 m of height and 1.732 m forward.
    ahead = mount @ [0.0, 0.0, 2.0, 1.0]
    np.testing.assert_allclose(ahead, [0.4 + math.sqrt(3), 0.0, 2.5, 1.0], atol=1e-12)
    # The camera's right is the vehicle's -y (y points left).
    np.testing.assert_allclose(mount @ [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(mount[:3, :3].T @ mount[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(mount[:3, :3]) == pytest.approx(1.0)
