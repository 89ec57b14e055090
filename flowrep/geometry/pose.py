"""Poses of cameras and bodies, and the motions between them, as rigid 4x4 matrices.

A matrix is named `<to>_from_<from>`, so that neighbours in a product cancel.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Literal, ParamSpec, TypeAlias, TypeVar

import torch
from torch import Tensor

from flowrep.geometry.checks import check_name, check_shape, common_batch, first_wrong, over_points

_P = ParamSpec("_P")
_R = TypeVar("_R")

# The numbers of a pose in their order: xyz is the position, rotvec the rotation's axis times its
# angle in radians (OpenCV's rvec), rotation its matrix row by row, four letters a unit quaternion.
PoseLayout: TypeAlias = Literal[
    "matrix", "matrix_3x4", "rotation_xyz", "xyz_xyzw", "xyz_wxyz", "xyzw_xyz", "wxyz_xyz",
    "rotvec_xyz", "xyz_rotvec", "xyz_yaw", "xyz_yaw_pitch",
]  # fmt: skip
PoseDirection: TypeAlias = Literal["camera_to_world", "world_to_camera"]
CameraAxes: TypeAlias = Literal["opencv", "opengl", "ned", "x_forward_z_up", "unreal", "unity"]

POSE_SHAPES: dict[str, tuple[int, ...]] = {
    "matrix": (4, 4), "matrix_3x4": (3, 4), "rotation_xyz": (12,), "xyz_xyzw": (7,),
    "xyz_wxyz": (7,), "xyzw_xyz": (7,), "wxyz_xyz": (7,), "rotvec_xyz": (6,), "xyz_rotvec": (6,),
    "xyz_yaw": (4,), "xyz_yaw_pitch": (5,),
}  # fmt: skip

# OpenCV's right, down and forward, each as (axis, sign) in the other convention.
_OPENCV_AXES = {
    "opencv": ((0, 1), (1, 1), (2, 1)),
    "opengl": ((0, 1), (1, -1), (2, -1)),  # x right, y up, z backward
    "ned": ((1, 1), (2, 1), (0, 1)),  # x forward, y right, z down
    "x_forward_z_up": ((1, -1), (2, -1), (0, 1)),  # x forward, y left, z up
    "unreal": ((1, 1), (2, -1), (0, 1)),  # x forward, y right, z up
    "unity": ((0, 1), (1, -1), (2, 1)),  # x right, y up, z forward
}
# The last two are left-handed; reversing this world axis makes their worlds right-handed.
_OPPOSITE_WORLD_AXIS = {"unreal": 1, "unity": 2}


def without_autocast(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Makes a function ignore autocast, which would round metres to bfloat16."""

    @functools.wraps(function)
    def exact(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        kinds = {x.device.type for x in (*args, *kwargs.values()) if isinstance(x, Tensor)}
        with torch.autocast("cuda" if "cuda" in kinds else "cpu", enabled=False):
            return function(*args, **kwargs)

    return exact


@without_autocast
def invert_rigid(a_from_b: Tensor) -> Tensor:
    """Returns `b_from_a`, the inverse of a rotation and translation, `[*B, 4, 4]` each.

    Convention: the inverse of (R, t) is (Rᵀ, -Rᵀt); this is wrong for matrices with scale or shear.

    >>> a_from_b = torch.eye(4)
    >>> a_from_b[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    >>> invert_rigid(a_from_b)[:3, 3]
    tensor([-1., -2., -3.])
    """
    check_shape("a_from_b", a_from_b, (4, 4))
    rotation_b_from_a = a_from_b[..., :3, :3].mT
    translation = -rotation_b_from_a @ a_from_b[..., :3, 3:]
    return torch.cat([torch.cat([rotation_b_from_a, translation], -1), a_from_b[..., 3:, :]], -2)


def relative_motion(
    world_from_prev: Tensor, world_from_curr: Tensor, *, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Returns `prev_from_curr` `[*B, 4, 4]`, composed in float64 and returned as `dtype`.

    Convention: it transforms a point from the current camera's coordinates to the previous camera's
    (R and T of equation 11 of the paper). A world kilometres wide costs no precision, since large
    coordinates cancel before the result is rounded. Equal poses give exactly the identity.

    Args:
        world_from_prev: `[*B, 4, 4]`, pose of the previous camera (camera-to-world), metres.
        world_from_curr: `[*B, 4, 4]`, pose of the current camera.
        dtype: of the result.

    >>> prev, curr = torch.eye(4), torch.eye(4)
    >>> curr[2, 3] = 0.5  # half a metre forward along the camera's z
    >>> relative_motion(prev, curr)[:3, 3]
    tensor([0.0000, 0.0000, 0.5000])
    """
    check_shape("world_from_prev", world_from_prev, (4, 4))
    check_shape("world_from_curr", world_from_curr, (4, 4))
    common_batch(
        world_from_prev=world_from_prev.shape[:-2], world_from_curr=world_from_curr.shape[:-2]
    )
    # prev_from_world · world_from_curr, with the translations subtracted first.
    rotation_prev_from_world = world_from_prev[..., :3, :3].double().mT
    rotation = rotation_prev_from_world @ world_from_curr[..., :3, :3].double()
    baseline_world = world_from_curr[..., :3, 3:].double() - world_from_prev[..., :3, 3:].double()
    translation = rotation_prev_from_world @ baseline_world
    bottom = world_from_curr[..., 3:, :].double().expand(*rotation.shape[:-2], 1, 4)
    motion = torch.cat([torch.cat([rotation, translation], -1), bottom], -2).to(dtype)
    # The product of a rotation and its transpose is the identity only up to rounding.
    still = (world_from_prev == world_from_curr).flatten(-2).all(-1)
    identity = torch.eye(4, dtype=dtype, device=motion.device)
    return torch.where(still[..., None, None], identity, motion)


def instance_motion(
    world_from_prev: Tensor,
    world_from_curr: Tensor,
    world_from_prev_body: Tensor,
    world_from_curr_body: Tensor,
    *,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Returns the motion of each body relative to the camera, `[*B, 1 + N, 4, 4]`.

    Convention: row 0 is the static world's, `prev_from_curr`; row 1 + i transforms a point fixed to
    body i from the current camera's coordinates to the previous camera's, at the previous frame. If
    a body's pose has not changed, its row is bitwise equal to row 0. Motions are composed in
    float64. A body's axes and origin don't matter, as long as they are fixed to it.

    Args:
        world_from_prev: see `relative_motion`, as for `world_from_curr` and `dtype`.
        world_from_prev_body: `[*B, N, 4, 4]`, poses of the bodies at the previous frame.
        world_from_curr_body: `[*B, N, 4, 4]`, poses of the same bodies, in the same order, now.

    >>> camera, before, now = torch.eye(4), torch.eye(4), torch.eye(4)
    >>> now[0, 3] = 0.5  # the body moved half a metre along x
    >>> instance_motion(camera, camera, before[None], now[None])[:, 0, 3]
    tensor([ 0.0000, -0.5000])
    """
    check_shape("world_from_prev_body", world_from_prev_body, ("N", 4, 4))
    check_shape("world_from_curr_body", world_from_curr_body, ("N", 4, 4))
    if world_from_prev_body.shape[-3] != world_from_curr_body.shape[-3]:
        raise ValueError(
            f"the same bodies are needed before and now, got {world_from_prev_body.shape[-3]} "
            f"and {world_from_curr_body.shape[-3]}"
        )
    camera = relative_motion(world_from_prev, world_from_curr, dtype=dtype).unsqueeze(-3)
    # A point of the body has the same body coordinates at both frames, so the motion is
    # prev_from_prev_body · curr_body_from_curr. Both factors are relative motions, in which large
    # world coordinates cancel.
    prev_body_from_prev = relative_motion(
        world_from_prev_body, world_from_prev.unsqueeze(-3), dtype=torch.float64
    )
    curr_body_from_curr = relative_motion(
        world_from_curr_body, world_from_curr.unsqueeze(-3), dtype=torch.float64
    )
    bodies = relative_motion(prev_body_from_prev, curr_body_from_curr, dtype=dtype)
    still = (world_from_prev_body == world_from_curr_body).flatten(-2).all(-1)
    bodies = torch.where(still[..., None, None], camera, bodies)
    return torch.cat([camera.expand(*bodies.shape[:-3], 1, 4, 4), bodies], -3)


def instance_rows(ids: Tensor, body_ids: Tensor) -> Tensor:
    """Returns each pixel's row of `instance_motion`, in the shape of `ids`.

    Convention: id `body_ids[i]` becomes 1 + i; any other id, negative ones included, becomes 0, the
    static world. The result is uint8, or int32 for 256 bodies and more.

    Args:
        ids: integers of any shape, as the simulator renders them.
        body_ids: `[N]`, integers, in the order of the bodies' poses.

    >>> ids = torch.tensor([[[0, 17, 3, -1, 18]]])
    >>> instance_rows(ids, torch.tensor([17, 3]))
    tensor([[[0, 1, 2, 0, 0]]], dtype=torch.uint8)
    """
    check_shape("ids", ids, (), ids=True)
    check_shape("body_ids", body_ids, (), ids=True)
    if body_ids.ndim != 1:
        raise ValueError(f"body_ids must be [N], got {list(body_ids.shape)}")
    count = len(body_ids)
    dtype = torch.uint8 if count < 256 else torch.int32
    if count == 0:
        return torch.zeros_like(ids, dtype=dtype)
    # A binary search instead of a table, because ids may be as large as a packed colour.
    ascending, order = body_ids.long().sort()
    ids = ids.long()
    nearest = torch.searchsorted(ascending, ids.contiguous()).clamp(max=count - 1)
    return torch.where(ascending[nearest] == ids, order[nearest] + 1, 0).to(dtype)


def check_rigid(name: str, a_from_b: Tensor, *, tolerance: float = 1e-3) -> None:
    """Checks that every transform `[*B, 4, 4]` is a rotation and a translation.

    The check waits for a GPU.

    Args:
        name: of the argument, for the message.
        a_from_b: the transforms.
        tolerance: on each element of R Rᵀ - I and of the last row.

    Raises:
        ValueError: names the first transform that has nan or inf, a last row other than
            (0, 0, 0, 1), scale or shear, or is left-handed.

    >>> check_rigid("pose", torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])))
    Traceback (most recent call last):
    ValueError: pose is left-handed (a mirror image, determinant -1): flip one axis ...
    """
    check_shape(name, a_from_b, (4, 4))
    transform = a_from_b.detach().double()
    rotation = transform[..., :3, :3]
    identity = torch.eye(4, dtype=transform.dtype, device=transform.device)
    last_row_off = (transform[..., 3, :] - identity[3]).abs().amax(-1) > tolerance
    sheared = (rotation @ rotation.mT - identity[:3, :3]).abs().flatten(-2).amax(-1) > tolerance
    complaints = {
        "holds nan or inf": ~transform.isfinite().flatten(-2).all(-1),
        "has a last row other than (0, 0, 0, 1): is it transposed?": last_row_off,
        "is not rigid (its rotation has scale or shear): divide the scale out": sheared,
        "is left-handed (a mirror image, determinant -1): flip one axis of the camera "
        "and of the world alike": torch.linalg.det(rotation.nan_to_num(0.0, 0.0, 0.0)) < 0,
    }
    for complaint, wrong in complaints.items():
        if bool(wrong.any()):
            where, index = first_wrong(name, wrong)
            raise ValueError(f"{where} {complaint}; got {a_from_b[index].tolist()}")


@without_autocast
def transform_points(a_from_b: Tensor, points_b: Tensor) -> Tensor:
    """Returns points `[*B, ..., 3]` in coordinates a, in the wider of the two float types.

    Args:
        a_from_b: `[*B, 4, 4]`; its batch dims are the leading dims of `points_b`.
        points_b: `[*B, ..., 3]`, metres, in coordinates b.

    >>> a_from_b = torch.eye(4)
    >>> a_from_b[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    >>> transform_points(a_from_b, torch.tensor([[10.0, 10.0, 10.0]]))
    tensor([[11., 12., 13.]])
    """
    check_shape("a_from_b", a_from_b, (4, 4))
    check_shape("points_b", points_b, (3,))
    dtype = torch.promote_types(a_from_b.dtype, points_b.dtype)
    a_from_b = over_points("a_from_b", a_from_b, "points_b", points_b).to(dtype)
    rotated = (a_from_b[..., :3, :3] @ points_b.to(dtype).unsqueeze(-1)).squeeze(-1)
    return rotated + a_from_b[..., :3, 3]


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Returns the rotation matrix `[*B, 3, 3]` of a rotation vector `[*B, 3]`, rad."""
    # As accurate as torch.linalg.matrix_exp of the cross-product matrix, in a fraction of the time.
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    # Rodrigues: I + sin(a)/a [r] + (1 - cos(a))/a^2 [r]^2; torch.sinc(t) is sin(pi t)/(pi t).
    turns = vector.norm(dim=-1)[..., None, None] / math.pi
    identity = torch.eye(3, dtype=cross.dtype, device=cross.device)
    rotation = identity + torch.sinc(turns) * cross
    return rotation + 0.5 * torch.sinc(turns / 2).square() * (cross @ cross)


def adapt_pose(
    pose: Tensor,
    *,
    layout: PoseLayout = "matrix",
    direction: PoseDirection = "camera_to_world",
    axes: CameraAxes = "opencv",
    check: bool = True,
) -> Tensor:
    """Returns `world_from_cam` `[*B, 4, 4]`, float64, of a camera with OpenCV's axes.

    Convention: `axes` says where the camera's axes point: `"opencv"` x right, y down, z forward;
    `"opengl"` (also Blender) x right, y up, z backward; `"ned"` x forward, y right, z down;
    `"x_forward_z_up"` x forward, y left, z up. The world's axes stay as they are, since they cancel
    in every relative motion.

    In two conventions, both camera and world are left-handed: `"unreal"` (also CARLA) x forward,
    y right, z up; `"unity"` x right, y up, z forward. Their worlds become right-handed: unreal's y
    then points left, unity's z backward. Give poses of bodies the same axes.

    Args:
        pose: in the shape of its `layout`.
        layout: `"matrix"` `[*B, 4, 4]`; `"matrix_3x4"`, without the last row; `"rotation_xyz"`
            `[*B, 12]`, the rotation row by row and the translation; `"xyz_xyzw"`, `"xyz_wxyz"`,
            `"xyzw_xyz"` or `"wxyz_xyz"` `[*B, 7]`, translation and unit quaternion, with the real
            part last or first; `"rotvec_xyz"` or `"xyz_rotvec"` `[*B, 6]`, with a rotation vector
            in radians; `"xyz_yaw"` `[*B, 4]` or `"xyz_yaw_pitch"` `[*B, 5]`, with angles in
            radians, in a world whose z is up: yaw from the world's x to its y, pitch upwards. With
            angles, the camera looks along its x axis (`axes="x_forward_z_up"` or `"unreal"`).
        direction: `"camera_to_world"` transforms points from camera to world coordinates;
            `"world_to_camera"` (extrinsics) is the inverse.
        axes: see above.
        check: whether to check that poses are rigid, which waits for a GPU.

    Raises:
        ValueError: an option is unknown, angles come with a camera that looks along its z, or, with
            `check`, a pose is not rigid.

    >>> pose = torch.tensor([5.0, 6.0, 7.0, 0.0, 0.0, 0.0, 1.0])
    >>> world_from_cam = adapt_pose(pose, layout="xyz_xyzw", axes="x_forward_z_up")
    >>> world_from_cam @ torch.tensor([0.0, 0.0, 1.0, 1.0]).double()  # a metre ahead: along x
    tensor([6., 6., 7., 1.], dtype=torch.float64)
    """
    check_name("layout", layout, PoseLayout)
    check_name("direction", direction, PoseDirection)
    check_name("axes", axes, CameraAxes)
    if layout.startswith("xyz_yaw") and axes not in ("x_forward_z_up", "unreal"):
        raise ValueError(
            f"layout {layout!r} is for a camera that looks along its x axis, with z up: "
            f'axes="x_forward_z_up" or "unreal", not {axes!r}'
        )
    check_shape("pose", pose, POSE_SHAPES[layout])
    if layout == "matrix":
        matrix = pose.double()
    elif layout == "matrix_3x4":
        matrix = _with_last_row(pose.double())
    elif layout == "rotation_xyz":
        rotation, translation = pose.double().split([9, 3], -1)
        matrix = _rigid(rotation.unflatten(-1, (3, 3)), translation)
    elif "rotvec" in layout:
        first, last = pose.double().split(3, -1)
        vector, translation = (first, last) if layout == "rotvec_xyz" else (last, first)
        matrix = _rigid(rotation_from_vector(vector), translation)
    elif layout.startswith("xyz_yaw"):
        matrix = _pose_from_angles(pose.double())
    else:
        matrix = pose_from_quaternion(pose, layout, check=check)
    if check:
        check_rigid("pose", matrix)
    if direction == "world_to_camera":
        matrix = invert_rigid(matrix)
    # Each column is one of the given columns or its opposite. A matrix product would round, and its
    # constant would be copied to a GPU in every call.
    columns = [sign * matrix[..., axis : axis + 1] for axis, sign in _OPENCV_AXES[axes]]
    matrix = torch.cat([*columns, matrix[..., 3:]], -1)
    if (opposite := _OPPOSITE_WORLD_AXIS.get(axes)) is None:
        return matrix
    rows = matrix.split(1, -2)
    return torch.cat([-row if axis == opposite else row for axis, row in enumerate(rows)], -2)


def _pose_from_angles(pose: Tensor) -> Tensor:
    """Returns Rz(yaw) · Ry(−pitch) with the translation, `[*B, 4, 4]`."""
    x, y, z, yaw, *rest = pose.unbind(-1)
    pitch = rest[0] if rest else torch.zeros_like(yaw)
    cos, sin, up, ahead = yaw.cos(), yaw.sin(), pitch.sin(), pitch.cos()
    rows = [
        *(cos * ahead, -sin, -cos * up, x),
        *(sin * ahead, cos, -sin * up, y),
        *(up, torch.zeros_like(yaw), ahead, z),
    ]
    return _with_last_row(torch.stack(rows, -1).unflatten(-1, (3, 4)))


def _rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    return _with_last_row(torch.cat([rotation, translation.unsqueeze(-1)], -1))


def _with_last_row(pose: Tensor) -> Tensor:
    """Returns `[*B, 4, 4]` from `[*B, 3, 4]`."""
    last = torch.zeros_like(pose[..., :1, :])
    last[..., 3] = 1.0
    return torch.cat([pose, last], -2)


def pose_from_quaternion(pose: Tensor, layout: PoseLayout, *, check: bool = True) -> Tensor:
    """Returns the 4x4 matrix `[*B, 4, 4]`, float64, of a translation and a unit quaternion.

    Args:
        pose: `[*B, 7]`, x, y, z in metres and the quaternion, in the order of the layout.
        layout: `"xyz_xyzw"`, `"xyz_wxyz"`, `"xyzw_xyz"` or `"wxyz_xyz"`.
        check: whether a quaternion whose length differs from 1 by 0.001 raises ValueError; this
            waits for a GPU. Quaternions are normalised in either case.

    Raises:
        ValueError: with `check`, a quaternion's length is not 1.

    >>> half_turn_about_z = torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0])
    >>> pose_from_quaternion(half_turn_about_z, "xyz_xyzw")[0]
    tensor([-1.,  0.,  0.,  1.], dtype=torch.float64)
    """
    check_shape("pose", pose, (7,))
    first, last = layout.split("_")
    parts = pose.double().split([len(first), len(last)], -1)
    translation, quaternion = parts if first == "xyz" else parts[::-1]
    norm = quaternion.norm(dim=-1, keepdim=True)
    if check and not bool(((norm - 1.0).abs() < 1e-3).all()):
        raise ValueError(
            f"pose: a quaternion must have length 1, got {norm.flatten().tolist()[:8]}; "
            f"layout {layout!r} says where it stands"
        )
    quaternion = quaternion / norm
    x, y, z, w = (quaternion.roll(-1, -1) if "wxyz" in layout else quaternion).unbind(-1)
    tx, ty, tz = translation.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), tx),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), ty),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), tz),
    ]
    return _with_last_row(torch.stack(rows, -1).unflatten(-1, (3, 4)))
