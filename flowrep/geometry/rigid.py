"""Rigid 4x4 transforms, named `<to>_from_<from>` so that neighbours in a product cancel."""

from __future__ import annotations

import torch
from torch import Tensor

from flowrep.geometry.checks import broadcast_batch, check_shape


def invert_rigid(a_from_b: Tensor) -> Tensor:
    """Returns `b_from_a`, the inverse `[*B, 4, 4]` of a rigid transform.

    Args:
        a_from_b: `[*B, 4, 4]`, a rotation and a translation (no scale, no shear).

    Raises:
        ValueError: not `[*B, 4, 4]`.
        TypeError: no float tensor.

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
    """Returns `prev_from_curr` `[*B, 4, 4]`, composed in float64 and handed on as `dtype`.

    Convention: it takes a point in the current camera's frame into the previous camera's frame
    (R and T of equation 11 of the paper). A world kilometres wide costs no precision, since the
    large coordinates cancel before the result is rounded.

    Args:
        world_from_prev: `[*B, 4, 4]`, pose of the previous camera (camera-to-world).
        world_from_curr: `[*B, 4, 4]`, pose of the current camera.
        dtype: of the result.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is no float tensor.

    >>> prev, curr = torch.eye(4), torch.eye(4)
    >>> curr[2, 3] = 0.5  # half a metre forward along the camera's z
    >>> relative_motion(prev, curr)[:3, 3]
    tensor([0.0000, 0.0000, 0.5000])
    """
    check_shape("world_from_prev", world_from_prev, (4, 4))
    check_shape("world_from_curr", world_from_curr, (4, 4))
    broadcast_batch(
        world_from_prev=world_from_prev.shape[:-2], world_from_curr=world_from_curr.shape[:-2]
    )
    # prev_from_world * world_from_curr, with the translations subtracted first.
    rotation_prev_from_world = world_from_prev[..., :3, :3].double().mT
    rotation = rotation_prev_from_world @ world_from_curr[..., :3, :3].double()
    baseline_world = world_from_curr[..., :3, 3:].double() - world_from_prev[..., :3, 3:].double()
    translation = rotation_prev_from_world @ baseline_world
    bottom = world_from_curr[..., 3:, :].double().expand(*rotation.shape[:-2], 1, 4)
    return torch.cat([torch.cat([rotation, translation], -1), bottom], -2).to(dtype)


def transform_points(a_from_b: Tensor, points_b: Tensor) -> Tensor:
    """Returns points `[*B, ..., 3]` expressed in frame a.

    Args:
        a_from_b: `[*B, 4, 4]`; its batch dims are the leading dims of `points_b`.
        points_b: `[*B, ..., 3]`, in frame b.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is no float tensor.

    >>> a_from_b = torch.eye(4)
    >>> a_from_b[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    >>> transform_points(a_from_b, torch.tensor([[10.0, 10.0, 10.0]]))
    tensor([[11., 12., 13.]])
    """
    check_shape("a_from_b", a_from_b, (4, 4))
    check_shape("points_b", points_b, (3,))
    point_dims = points_b.ndim - 1 - (a_from_b.ndim - 2)
    if point_dims < 0:
        raise ValueError(
            f"a_from_b has batch {list(a_from_b.shape[:-2])}, which points_b "
            f"{list(points_b.shape)} lacks; its batch dims are the leading dims of points_b"
        )
    broadcast_batch(a_from_b=a_from_b.shape[:-2], points_b=points_b.shape[: a_from_b.ndim - 2])
    a_from_b = a_from_b.reshape(*a_from_b.shape[:-2], *[1] * point_dims, 4, 4)
    rotated = (a_from_b[..., :3, :3] @ points_b.unsqueeze(-1)).squeeze(-1)
    return rotated + a_from_b[..., :3, 3]
