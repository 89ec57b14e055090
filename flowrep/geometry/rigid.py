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
    """Returns `prev_from_curr` `[*B, 4, 4]`, composed in float64 and returned as `dtype`.

    Convention: it maps a point from the current camera's frame to the previous camera's frame
    (R and T of equation 11 of the paper). A world kilometres wide costs no precision, since large
    coordinates cancel before the result is rounded. Equal poses give exactly the identity.

    Args:
        world_from_prev: `[*B, 4, 4]`, pose of the previous camera (camera-to-world).
        world_from_curr: `[*B, 4, 4]`, pose of the current camera.
        dtype: of the result.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is not a float tensor.

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
    motion = torch.cat([torch.cat([rotation, translation], -1), bottom], -2).to(dtype)
    # The product of a rotation and its transpose is the identity up to rounding.
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

    Convention: row 0 is the static world's, `prev_from_curr`; row 1 + i maps a point fixed to body
    i from the current camera's frame to its place in the previous camera's frame. If a body's pose
    has not changed, its row is bitwise equal to row 0. Motions are composed in float64. The choice
    of a body's axes and origin doesn't matter, as long as they are fixed to it.

    Args:
        world_from_prev: `[*B, 4, 4]`, pose of the previous camera (camera-to-world).
        world_from_curr: `[*B, 4, 4]`, pose of the current camera.
        world_from_prev_body: `[*B, N, 4, 4]`, poses of the bodies at the previous frame.
        world_from_curr_body: `[*B, N, 4, 4]`, poses of the same bodies, in the same order, now.
        dtype: of the result.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is not a float tensor.

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
    # A point's previous place: the inverse of the body's motion, in the cameras' frames.
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


def check_rigid(name: str, a_from_b: Tensor, *, tolerance: float = 1e-3) -> None:
    """Checks that every transform is a rotation and a translation.

    The check waits for a GPU.

    Args:
        name: the argument's name, for the message.
        a_from_b: `[*B, 4, 4]`.
        tolerance: on each element of R R^T - I and on the last row.

    Raises:
        ValueError: for nan or inf, a last row other than (0, 0, 0, 1), scale or shear, or a
            left-handed frame; names the index of the first such transform in the batch.
        TypeError: if it is not a float tensor.

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
            index = wrong.nonzero()[0].tolist()
            where = f"{name}[{', '.join(map(str, index))}]" if index else name
            shown = a_from_b[tuple(index)].tolist()
            raise ValueError(f"{where} {complaint}; got {shown}")


def transform_points(a_from_b: Tensor, points_b: Tensor) -> Tensor:
    """Returns points `[*B, ..., 3]` expressed in frame a, in the wider float type.

    Args:
        a_from_b: `[*B, 4, 4]`; its batch dims are the leading dims of `points_b`.
        points_b: `[*B, ..., 3]`, in frame b.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is not a float tensor.

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
    dtype = torch.promote_types(a_from_b.dtype, points_b.dtype)
    a_from_b = a_from_b.to(dtype).reshape(*a_from_b.shape[:-2], *[1] * point_dims, 4, 4)
    rotated = (a_from_b[..., :3, :3] @ points_b.to(dtype).unsqueeze(-1)).squeeze(-1)
    return rotated + a_from_b[..., :3, 3]
