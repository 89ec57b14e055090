"""The simulated pinhole camera: intrinsics, OpenGL matrices, depth in metres.

Convention: camera axes are OpenCV's (x right, y down, z forward), pixel (0, 0)'s centre is
(0.5, 0.5), depth is metres along z.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flowrep.config.options import PRINCIPAL_POINT_SHIFT_PX
from flowrep.simulator.motion import rigid_inverse

if TYPE_CHECKING:  # scenes need shapely and pydantic, which `flowrep.pybullet` shouldn't import
    from flowrep.scenes.scene import CameraConfig

Matrix = NDArray[np.float64]
_GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


def sampled_intrinsics(fx_px: float, fy_px: float, height_px: int, width_px: int) -> Matrix:
    """Returns the K [3, 3] at which PyBullet's software renderer takes its samples."""
    cx_px, cy_px = np.array([width_px, height_px]) / 2 + PRINCIPAL_POINT_SHIFT_PX
    return np.array([[fx_px, 0.0, cx_px], [0.0, fy_px, cy_px], [0.0, 0.0, 1.0]])


def gl_projection(
    focal_px: float, height_px: int, width_px: int, near_m: float, far_m: float
) -> list[float]:
    """Returns the 16 numbers, column by column, of the OpenGL projection of a centred camera."""
    depth_sum, depth_gap = far_m + near_m, far_m - near_m
    scales = [2 * focal_px / width_px, 2 * focal_px / height_px, -depth_sum / depth_gap, 0.0]
    projection = np.diag(scales)
    projection[2, 3], projection[3, 2] = -2 * far_m * near_m / depth_gap, -1.0
    return projection.T.ravel().tolist()


def gl_view(cam_from_world: Matrix) -> list[float]:
    """Returns the 16 numbers, column by column, of the OpenGL view matrix (y up, z backward)."""
    return (_GL_FROM_CV @ cam_from_world).T.ravel().tolist()


def pose_of_view(view: Sequence[float]) -> Matrix:
    """Returns world_from_cam [4, 4], with OpenCV's axes, of the 16 numbers of a view matrix."""
    numbers = np.asarray(view, dtype=np.float64)
    if numbers.size != 16:
        raise ValueError(f"a view has 16 numbers, column by column; got {numbers.size}")
    gl_from_world = numbers.reshape(4, 4).T
    rotation = gl_from_world[:3, :3]
    if not abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3:
        raise ValueError(f"a view is a rotation and a translation; got {numbers.tolist()}")
    return rigid_inverse(gl_from_world) @ _GL_FROM_CV


def vehicle_from_camera(camera: CameraConfig) -> Matrix:
    """Returns the camera's pose on the vehicle [4, 4] (vehicle axes: x forward, z up)."""
    pitch = math.radians(camera.pitch_deg)
    sine, cosine = math.sin(pitch), math.cos(pitch)
    return np.array(
        [
            [0.0, sine, cosine, camera.mount_forward_m],
            [-1.0, 0.0, 0.0, 0.0],
            [0.0, -cosine, sine, camera.mount_height_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def depth_from_zbuffer(
    zbuffer: NDArray[np.float32], near_m: float, far_m: float
) -> NDArray[np.float32]:
    """Returns depth along z in metres from OpenGL depth-buffer values in [0, 1]."""
    # The usual formula has far - (far - near) · z, which loses precision near z = 1. There, 1 - z
    # is exact in float32.
    gap = (np.float32(1.0) - zbuffer) * np.float32(far_m - near_m) + np.float32(near_m)
    return np.float32(far_m * near_m) / gap
