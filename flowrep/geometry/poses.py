"""Conversion of poses from simulators and robots to `world_from_cam` of an OpenCV camera."""

from __future__ import annotations

from typing import Literal, TypeAlias

import torch
from torch import Tensor

from flowrep.geometry.checks import check_name, check_shape
from flowrep.geometry.rigid import check_rigid, invert_rigid

PoseLayout: TypeAlias = Literal["matrix", "xyz_xyzw", "xyz_wxyz"]
PoseDirection: TypeAlias = Literal["camera_to_world", "world_to_camera"]
CameraAxes: TypeAlias = Literal["opencv", "opengl", "ned", "x_forward_z_up"]

# The columns are OpenCV's right, down and forward, expressed in the other convention.
_GIVEN_FROM_OPENCV: dict[str, list[list[float]]] = {
    "opencv": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "opengl": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],  # x right, y up, z backward
    "ned": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],  # x forward, y right, z down
    "x_forward_z_up": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],  # x forward, y left, z up
}


def adapt_pose(
    pose: Tensor,
    *,
    layout: PoseLayout = "matrix",
    direction: PoseDirection = "camera_to_world",
    axes: CameraAxes = "opencv",
    check: bool = True,
) -> Tensor:
    """Returns `world_from_cam` `[*B, 4, 4]`, float64, of a camera with OpenCV's axes.

    Convention: `axes` are the directions of the camera's own axes: `"opencv"` x right, y down,
    z forward; `"opengl"` (also Blender) x right, y up, z backward; `"ned"` x forward, y right,
    z down; `"x_forward_z_up"` x forward, y left, z up. The world's axes are left unchanged, as they
    cancel in every relative motion.

    Args:
        pose: `[*B, 4, 4]`, or `[*B, 7]`: translation, then the unit quaternion.
        layout: `"matrix"`, `"xyz_xyzw"` (real part of the quaternion last) or `"xyz_wxyz"`
            (real part first).
        direction: `"camera_to_world"` maps points in the camera's frame to the world's;
            `"world_to_camera"` (extrinsics) is the inverse.
        axes: the camera's.
        check: whether an ill-formed pose raises ValueError. The check waits for a GPU.

    Raises:
        ValueError: an unknown name, a shape that does not fit, a pose that is not rigid.
        TypeError: no float tensor.

    >>> pose = torch.tensor([5.0, 6.0, 7.0, 0.0, 0.0, 0.0, 1.0])
    >>> world_from_cam = adapt_pose(pose, layout="xyz_xyzw", axes="x_forward_z_up")
    >>> world_from_cam @ torch.tensor([0.0, 0.0, 1.0, 1.0]).double()  # a metre ahead: along x
    tensor([6., 6., 7., 1.], dtype=torch.float64)
    """
    check_name("layout", layout, PoseLayout)
    check_name("direction", direction, PoseDirection)
    check_name("axes", axes, CameraAxes)
    if layout == "matrix":
        check_shape("pose", pose, (4, 4))
        matrix = pose.double()
    else:
        matrix = pose_from_quaternion(pose, layout, check=check)
    if check:
        check_rigid("pose", matrix)
    if direction == "world_to_camera":
        matrix = invert_rigid(matrix)
    rotation, rest = matrix[..., :3], matrix[..., 3:]
    # Each column is a given one or its opposite. They are picked, as a product would round and
    # constants created here would be copied to a GPU in every call.
    return torch.cat([*_columns(rotation, axes), rest], -1)


def _columns(rotation: Tensor, axes: CameraAxes) -> list[Tensor]:
    """Returns the columns of `world_from_given @ given_from_opencv`."""
    columns = []
    for opencv_axis in range(3):
        signs = [row[opencv_axis] for row in _GIVEN_FROM_OPENCV[axes]]
        given_axis = next(i for i, sign in enumerate(signs) if sign)
        column = rotation[..., given_axis : given_axis + 1]
        columns.append(column if signs[given_axis] > 0 else -column)
    return columns


def pose_from_quaternion(pose: Tensor, layout: PoseLayout, *, check: bool = True) -> Tensor:
    """Returns the 4x4 matrix `[*B, 4, 4]`, float64, of a translation and a unit quaternion.

    Args:
        pose: `[*B, 7]`, x, y, z, then the quaternion.
        layout: `"xyz_xyzw"` or `"xyz_wxyz"`.
        check: whether a quaternion whose length is not 1 raises ValueError. Rounding errors are
            normalised away in either case.

    Raises:
        ValueError: not `[*B, 7]`, or a quaternion that is not of unit length.
        TypeError: no float tensor.

    >>> half_turn_about_z = torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0])
    >>> pose_from_quaternion(half_turn_about_z, "xyz_xyzw")[0]
    tensor([-1.,  0.,  0.,  1.], dtype=torch.float64)
    """
    check_shape("pose", pose, (7,))
    translation, quaternion = pose.double().split([3, 4], -1)
    norm = quaternion.norm(dim=-1, keepdim=True)
    if check and not bool(((norm - 1.0).abs() < 1e-3).all()):
        raise ValueError(
            f"pose: a quaternion must have length 1, got {norm.flatten().tolist()[:8]}; "
            f"layout {layout!r} reads x, y, z and then the quaternion"
        )
    quaternion = quaternion / norm
    if layout == "xyz_wxyz":
        w, x, y, z = quaternion.unbind(-1)
    else:
        x, y, z, w = quaternion.unbind(-1)
    tx, ty, tz = translation.unbind(-1)
    zero, one = torch.zeros_like(w), torch.ones_like(w)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), tx),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), ty),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), tz),
        *(zero, zero, zero, one),
    ]
    return torch.stack(rows, -1).unflatten(-1, (4, 4))
