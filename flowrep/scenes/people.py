"""The parts of a person: an upper body and two swinging legs, each a rigid body.

Convention: a person's pose is (x, y, yaw, swing): position, heading, and the angle in radians by
which the left leg is swung backwards and the right leg forwards about the axis of the hips.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

RADIUS_M, HEIGHT_M = 0.3, 1.75
"""The collision cylinder."""

PARTS = ("upper body", "left leg", "right leg")
HIP_M, _HIP_ASIDE_M = 0.82, 0.1
_SIDES = np.array([1.0, -1.0])  # of the legs: left is +y


class Parts(NamedTuple):
    """Poses of the parts of P people: positions [P, 3, 3] in metres, quaternions [P, 3, 4]."""

    positions: Array
    quaternions_xyzw: Array


def place_parts(poses: Array) -> Parts:
    """Returns the poses of the parts of people at poses [P, 4]."""
    x, y, yaw, swing = poses.T
    positions = np.zeros((len(poses), len(PARTS), 3))
    positions[:, :, 0] = x[:, None]
    positions[:, :, 1] = y[:, None]
    aside = _HIP_ASIDE_M * _SIDES
    positions[:, 1:, 0] -= np.sin(yaw)[:, None] * aside
    positions[:, 1:, 1] += np.cos(yaw)[:, None] * aside
    positions[:, 1:, 2] = HIP_M
    # Rotation about y by the leg's own angle, then about z by yaw.
    sine_z, cosine_z = np.sin(yaw / 2)[:, None], np.cos(yaw / 2)[:, None]
    half = np.zeros((len(poses), len(PARTS)))
    half[:, 1:] = 0.5 * swing[:, None] * _SIDES
    sine_y, cosine_y = np.sin(half), np.cos(half)
    quaternions = np.stack(
        [-sine_z * sine_y, cosine_z * sine_y, sine_z * cosine_y, cosine_z * cosine_y], axis=-1
    )
    return Parts(positions, quaternions)


def world_from_parts(poses: Array) -> Array:
    """Returns the parts of people at poses [P, 4] as transforms [3·P, 4, 4], person by person."""
    x, y, yaw, swing = poses.T
    transforms = np.zeros((len(poses), len(PARTS), 4, 4))
    sine, cosine = np.sin(yaw)[:, None], np.cos(yaw)[:, None]
    angle = np.zeros((len(poses), len(PARTS)))
    angle[:, 1:] = swing[:, None] * _SIDES
    sine_y, cosine_y = np.sin(angle), np.cos(angle)
    # Rz(yaw) · Ry(angle)
    transforms[..., 0, 0] = cosine * cosine_y
    transforms[..., 0, 1] = -sine
    transforms[..., 0, 2] = cosine * sine_y
    transforms[..., 1, 0] = sine * cosine_y
    transforms[..., 1, 1] = cosine
    transforms[..., 1, 2] = sine * sine_y
    transforms[..., 2, 0] = -sine_y
    transforms[..., 2, 2] = cosine_y
    aside = np.array([0.0, *(_HIP_ASIDE_M * _SIDES)])
    transforms[..., 0, 3] = x[:, None] - sine * aside
    transforms[..., 1, 3] = y[:, None] + cosine * aside
    transforms[:, 1:, 2, 3] = HIP_M
    transforms[..., 3, 3] = 1.0
    return transforms.reshape(-1, 4, 4)
