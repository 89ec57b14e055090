"""Rigid motion of upright bodies and of the camera between two steps, in float64.

Convention: `<to>_from_<from>`; a planar pose is (x, y, yaw), metres and radians, z up.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def planar(x_m: float | Array, y_m: float | Array, yaw_rad: float | Array) -> Array:
    """Returns the transforms [..., 4, 4] of planar poses, from body to world axes."""
    sine, cosine = np.sin(yaw_rad), np.cos(yaw_rad)
    transforms = np.zeros((*np.shape(yaw_rad), 4, 4))
    transforms[..., 0, 0] = transforms[..., 1, 1] = cosine
    transforms[..., 0, 1], transforms[..., 1, 0] = -sine, sine
    transforms[..., 0, 3], transforms[..., 1, 3] = x_m, y_m
    transforms[..., 2, 2] = transforms[..., 3, 3] = 1.0
    return transforms


def rigid_inverse(transforms: Array) -> Array:
    """Returns the inverses of rigid transforms [..., 4, 4]: (Rᵀ, -Rᵀt) for (R, t)."""
    inverse = np.zeros_like(transforms)
    rotation = transforms[..., :3, :3].swapaxes(-1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3:] = -(rotation @ transforms[..., :3, 3:])
    inverse[..., 3, 3] = 1.0
    return inverse


class CameraPose:
    """The pose of a camera on a vehicle and its inverse, or arrays of them."""

    def __init__(
        self, x_m: float | Array, y_m: float | Array, yaw_rad: float | Array, mount: Array
    ) -> None:
        """Applies the mount, vehicle_from_cam [4, 4], to vehicles at planar poses."""
        self.planar = np.stack([x_m, y_m, yaw_rad], axis=-1)
        self.world_from_cam = planar(x_m, y_m, yaw_rad) @ mount
        self.cam_from_world = rigid_inverse(self.world_from_cam)


def relative_camera(before: CameraPose, now: CameraPose) -> Array:
    """Returns prev_from_curr [..., 4, 4]; exactly the identity if the camera did not move."""
    motion = before.cam_from_world @ now.world_from_cam
    motion[(before.planar == now.planar).all(axis=-1)] = np.eye(4)
    return motion


def instance_motion(
    before: CameraPose, now: CameraPose, prev_world_from_body: Array, world_from_body: Array
) -> Array:
    """Returns prev_from_curr by instance [..., 1 + M, 4, 4] for bodies [..., M, 4, 4].

    Row 0 is the static world's. Row i maps a point fixed to body i from the current camera's frame
    to its position in the previous camera's frame. A body that kept its pose has exactly the
    numbers of row 0, so that its object flow is exactly zero.
    """
    static = relative_camera(before, now)[..., None, :, :]
    body_from_cam = rigid_inverse(world_from_body) @ now.world_from_cam[..., None, :, :]
    carried = before.cam_from_world[..., None, :, :] @ prev_world_from_body @ body_from_cam
    moved = (world_from_body != prev_world_from_body).any(axis=(-2, -1))
    return np.concatenate([static, np.where(moved[..., None, None], carried, static)], axis=-3)
