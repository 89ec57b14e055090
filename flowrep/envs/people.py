"""What a person is made of: an upper body and two legs that swing, each a rigid part of its own.

Convention: a person's pose is (x, y, yaw, swing): where it stands, where it looks, and the angle in
radians by which its left leg is swung backwards and its right leg forwards, about the hips' axis.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.envs.meshes import Mesh
from flowrep.envs.paint import SHIRTS, swatch

Array = NDArray[Any]

RADIUS_M, HEIGHT_M = 0.3, 1.75
"""The cylinder that a vehicle can hit."""

PARTS = ("upper body", "left leg", "right leg")
_HIP_M, _HIP_ASIDE_M = 0.82, 0.1
_SIDES = np.array([1.0, -1.0])  # of the legs: left is +y


class Parts(NamedTuple):
    """Where the parts of P people are: positions [P, 3, 3] in metres, quaternions [P, 3, 4]."""

    positions: Array
    quaternions_xyzw: Array


def person_meshes(variant: int) -> tuple[Mesh, ...]:
    """Returns the meshes of a person's `PARTS`; `variant` chooses the shirt.

    Looking along x. Seen from the side, as a vehicle sees who crosses, the arms alone are 0.6 m
    apart. A leg hangs from its hip, which is its origin.
    """
    shirt, skin = swatch(SHIRTS[variant % len(SHIRTS)]), swatch("skin")
    body = Mesh()
    for side, arm in ((-1, 0.19), (1, -0.19)):
        y = 0.26 * side
        body.box((arm - 0.11, y - 0.05, 0.95), (arm + 0.11, y + 0.05, 1.35), shirt)
        body.box((arm - 0.05, y - 0.05, 0.85), (arm + 0.11, y + 0.05, 0.95), skin, lid=False)
    body.box((-0.14, -0.21, 0.8), (0.14, 0.21, 1.47), shirt)
    body.box((-0.11, -0.1, 1.47), (0.12, 0.1, 1.68), skin, lid=False)
    body.box((-0.13, -0.11, 1.62), (0.12, 0.11, 1.75), swatch("hair"))
    legs = []
    for _ in _SIDES:
        leg = Mesh()
        leg.box((-0.1, -0.08, -_HIP_M + 0.1), (0.1, 0.08, 0.02), swatch("trousers"), lid=False)
        leg.box((-0.1, -0.08, -_HIP_M), (0.2, 0.08, -_HIP_M + 0.1), swatch("shoe"))
        legs.append(leg)
    return (body, *legs)


def place_parts(poses: Array) -> Parts:
    """Returns where the parts of people at poses [P, 4] are."""
    x, y, yaw, swing = poses.T
    positions = np.zeros((len(poses), len(PARTS), 3))
    positions[:, :, 0] = x[:, None]
    positions[:, :, 1] = y[:, None]
    aside = _HIP_ASIDE_M * _SIDES
    positions[:, 1:, 0] -= np.sin(yaw)[:, None] * aside
    positions[:, 1:, 1] += np.cos(yaw)[:, None] * aside
    positions[:, 1:, 2] = _HIP_M
    # The turn about z by yaw after the one about y by a leg's own angle.
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
    transforms[:, 1:, 2, 3] = _HIP_M
    transforms[..., 3, 3] = 1.0
    return transforms.reshape(-1, 4, 4)
