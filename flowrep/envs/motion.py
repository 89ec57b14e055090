"""Rigid motion of upright bodies and of the camera between two steps, in float64.

Convention: `<to>_from_<from>`; a planar pose is (x, y, yaw), metres and radians, z up.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def world_from_body(poses: Array) -> Array:
    """Returns the transforms [..., 4, 4] of planar poses [..., 3]."""
    matrix = np.zeros((*poses.shape[:-1], 4, 4))
    sine, cosine = np.sin(poses[..., 2]), np.cos(poses[..., 2])
    matrix[..., 0, 0] = matrix[..., 1, 1] = cosine
    matrix[..., 0, 1], matrix[..., 1, 0] = -sine, sine
    matrix[..., :2, 3] = poses[..., :2]
    matrix[..., 2, 2] = matrix[..., 3, 3] = 1.0
    return matrix


def inverse_rigid(matrix: Array) -> Array:
    """Returns the inverses of rigid transforms [..., 4, 4]."""
    inverse = np.zeros_like(matrix)
    rotation = np.swapaxes(matrix[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ matrix[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def relative_camera(prev_world_from_cam: Array, world_from_cam: Array) -> Array:
    """Returns prev_from_curr [4, 4]; the exact identity where the camera stood still."""
    if np.array_equal(prev_world_from_cam, world_from_cam):
        return np.eye(4)
    return inverse_rigid(prev_world_from_cam) @ world_from_cam


def instance_motion(
    prev_world_from_cam: Array, world_from_cam: Array, prev_poses: Array, poses: Array
) -> Array:
    """Returns prev_from_curr by instance [1 + P, 4, 4] for bodies at planar poses [P, 3].

    Row 0 is the static world's. Row i takes a point that rides on body i, seen now in the current
    camera's frame, to where the previous camera saw it. A body that kept its pose has row 0's very
    numbers, so that its object flow is exactly zero.
    """
    rows = np.empty((1 + len(poses), 4, 4))
    rows[:] = relative_camera(prev_world_from_cam, world_from_cam)
    moved = np.flatnonzero((poses != prev_poses).any(axis=-1))
    if moved.size:
        prev_from_curr_in_world = world_from_body(prev_poses[moved]) @ inverse_rigid(
            world_from_body(poses[moved])
        )
        prev_cam_from_world = inverse_rigid(prev_world_from_cam)
        rows[1 + moved] = prev_cam_from_world @ prev_from_curr_in_world @ world_from_cam
    return rows
