"""The renderer is asked, not believed: where it samples, and what its depth means."""

import math

import numpy as np
import pybullet
import pytest

from flowrep.pybullet import BulletCamera
from flowrep.scenes.scene import CameraConfig

NEAR_M, FAR_M = 0.2, 300.0
CAMERAS = [(36, 60, 48.5), (84, 84, 90.0), (61, 48, 58.0)]  # height, width, vertical field of view


@pytest.fixture(scope="module")
def slanted_plane():
    """A plane whose z in the camera grows to the right and upwards: 0.6 x - 0.5 y - z = -6."""
    client = pybullet.connect(pybullet.DIRECT)
    # The camera's frame is the world's here: z forward. Corners on z = 6 + 0.6 x - 0.5 y.
    corners = [(x, y, 6 + 0.6 * x - 0.5 * y) for x, y in ((-5, 5), (5, 5), (5, -5), (-5, -5))]
    mesh = {"vertices": corners, "indices": [0, 1, 2, 0, 2, 3], "physicsClientId": client}
    seen = pybullet.createVisualShape(pybullet.GEOM_MESH, **mesh)
    pybullet.createMultiBody(0, -1, seen, physicsClientId=client)
    yield client
    pybullet.disconnect(client)


@pytest.mark.parametrize("size", CAMERAS)
def test_the_sampled_intrinsics_put_unprojected_points_on_the_surface(slanted_plane, size):
    height, width, fov_deg = size
    view = np.diag([1.0, -1.0, -1.0, 1.0]).ravel().tolist()
    camera = BulletCamera(
        slanted_plane, width, height, fov_deg=fov_deg, near_m=NEAR_M, far_m=FAR_M, view=view
    )
    depth = camera.reset()["depth"][0]

    def error(cx, cy):
        x = (np.arange(width) + 0.5 - cx) / camera.K[0, 0]  # pixel (0, 0)'s centre is (0.5, 0.5)
        y = (np.arange(height)[:, None] + 0.5 - cy) / camera.K[1, 1]
        # z = 6 + 0.6 x z - 0.5 y z on the ray (x, y, 1) z.
        errors = np.abs(depth * (1.0 - 0.6 * x + 0.5 * y) / 6.0 - 1.0)[np.isfinite(depth)]
        assert errors.size > 0.5 * depth.size
        return np.median(errors)

    assert error(*camera.K[:2, 2]) < 3e-6
    # Rivals: the centred camera gives about 1e-2, the shift taken the other way twice that.
    for cx, cy in ((width / 2, height / 2), (width / 2 - 0.5, height / 2 + 0.5)):
        assert error(cx, cy) > 5e-3
    # A street's camera has the same K.
    same = CameraConfig(height, width, fov_deg, 1.5, 0.0, 0.0, NEAR_M, FAR_M)
    np.testing.assert_allclose(same.K, camera.K, rtol=1e-6)


def test_the_focal_length_follows_the_vertical_field_of_view():
    # Half of 48 rows over tan(30°): 24 / 0.57735 = 41.569; the width plays no part.
    camera = CameraConfig(48, 100, 60.0, 1.5, 0.0, 0.0, NEAR_M, FAR_M)
    assert camera.focal_px == pytest.approx(24 * math.sqrt(3))
    # The principal point is half a pixel right of the middle and above it, as measured above.
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
