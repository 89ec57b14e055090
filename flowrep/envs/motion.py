"""Rigid motion of upright bodies and of the camera between two steps, in float64.

Convention: `<to>_from_<from>`; a planar pose is (x, y, yaw), metres and radians, z up.
"""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


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


def planar_change(prev_poses: Array, poses: Array) -> Array:
    """Returns prev_from_curr in world axes [P, 4, 4] of bodies at planar poses [P, 3].

    It takes a point that rides on a body from where it is now to where it was.
    """
    change = np.zeros((4, len(poses), 4)).transpose(1, 0, 2)  # rows of all bodies side by side
    turn = prev_poses[:, 2] - poses[:, 2]
    sine, cosine = np.sin(turn), np.cos(turn)
    change[:, 0, 0] = change[:, 1, 1] = cosine
    change[:, 1, 0] = sine
    change[:, 0, 1] = -sine
    change[:, 0, 3] = prev_poses[:, 0] - (cosine * poses[:, 0] - sine * poses[:, 1])
    change[:, 1, 3] = prev_poses[:, 1] - (sine * poses[:, 0] + cosine * poses[:, 1])
    change[:, 2, 2] = change[:, 3, 3] = 1.0
    return change


class CameraPose:
    """Where a camera on a vehicle stands, both ways."""

    def __init__(self, x_m: float, y_m: float, yaw_rad: float, mount: Array) -> None:
        """Puts the mount, vehicle_from_cam [4, 4], on a vehicle at a planar pose."""
        self.planar = (x_m, y_m, yaw_rad)
        self.world_from_cam = planar(x_m, y_m, yaw_rad) @ mount
        # The inverse of a rigid transform (R, t) is (Rᵀ, -Rᵀt).
        inverse = self.world_from_cam.T.copy()
        inverse[:3, 3] = -(inverse[:3, :3] @ self.world_from_cam[:3, 3])
        inverse[3] = _LAST_ROW
        self.cam_from_world = inverse


def relative_camera(before: CameraPose, now: CameraPose) -> Array:
    """Returns prev_from_curr [4, 4] of one camera; the exact identity where it stood still."""
    if before.planar == now.planar:
        return np.eye(4)
    return before.cam_from_world @ now.world_from_cam


def instance_motion(before: CameraPose, now: CameraPose, prev_poses: Array, poses: Array) -> Array:
    """Returns prev_from_curr by instance [1 + P, 4, 4] for bodies at planar poses [P, 3].

    Row 0 is the static world's. Row i takes a point that rides on body i, seen now in the current
    camera's frame, to where the previous camera saw it. A body that kept its pose has row 0's very
    numbers, so that its object flow is exactly zero.
    """
    rows = np.empty((1 + len(poses), 4, 4))
    rows[:] = relative_camera(before, now)
    moved = (poses != prev_poses).any(axis=-1)
    if moved.any():
        change = planar_change(prev_poses, poses)
        # Two products of long matrices instead of many of 4 × 4.
        side_by_side = change.transpose(1, 0, 2).reshape(4, -1)
        product = (before.cam_from_world @ side_by_side).reshape(-1, 4) @ now.world_from_cam
        np.copyto(
            rows[1:], product.reshape(4, -1, 4).transpose(1, 0, 2), where=moved[:, None, None]
        )
    return rows
