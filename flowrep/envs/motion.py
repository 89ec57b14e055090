"""Rigid motion of upright bodies and of the camera between two steps, in float64.

Convention: `<to>_from_<from>`; a planar pose is (x, y, yaw), metres and radians, z up.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def planar(x_m: float, y_m: float, yaw_rad: float) -> Array:
    """Returns the transform [4, 4] of a planar pose: body axes into the world's."""
    sine, cosine = math.sin(yaw_rad), math.cos(yaw_rad)
    return np.array(
        [
            [cosine, -sine, 0.0, x_m],
            [sine, cosine, 0.0, y_m],
            [0.0, 0.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def rigid_inverse(transforms: Array) -> Array:
    """Returns the inverses of rigid transforms [..., 4, 4]: of (R, t) it is (Rᵀ, -Rᵀt)."""
    inverse = np.zeros_like(transforms)
    rotation = transforms[..., :3, :3].swapaxes(-1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3:] = -(rotation @ transforms[..., :3, 3:])
    inverse[..., 3, 3] = 1.0
    return inverse


class CameraPose:
    """Where a camera on a vehicle stands, both ways."""

    def __init__(self, x_m: float, y_m: float, yaw_rad: float, mount: Array) -> None:
        """Puts the mount, vehicle_from_cam [4, 4], on a vehicle at a planar pose."""
        self.planar = (x_m, y_m, yaw_rad)
        self.world_from_cam = planar(x_m, y_m, yaw_rad) @ mount
        self.cam_from_world = rigid_inverse(self.world_from_cam)


def relative_camera(before: CameraPose, now: CameraPose) -> Array:
    """Returns prev_from_curr [4, 4] of one camera; the exact identity where it stood still."""
    if before.planar == now.planar:
        return np.eye(4)
    return before.cam_from_world @ now.world_from_cam


def instance_motion(
    before: CameraPose, now: CameraPose, prev_world_from_body: Array, world_from_body: Array
) -> Array:
    """Returns prev_from_curr by instance [1 + N, 4, 4] for bodies [N, 4, 4].

    Row 0 is the static world's. Row i takes a point that rides on body i, seen now in the current
    camera's frame, to where the previous camera saw it. A body that kept its pose has row 0's very
    numbers, so that its object flow is exactly zero.
    """
    rows = np.empty((1 + len(world_from_body), 4, 4))
    rows[:] = relative_camera(before, now)
    moved = np.flatnonzero((world_from_body != prev_world_from_body).any(axis=(-2, -1)))
    if moved.size:
        body_from_cam = rigid_inverse(world_from_body[moved]) @ now.world_from_cam
        rows[1 + moved] = before.cam_from_world @ prev_world_from_body[moved] @ body_from_cam
    return rows
