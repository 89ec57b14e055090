"""Flow caused by rigid motion: of a static world, of moving bodies, and the difference.

Every function uses the closed form of `flowrep.geometry.closed_form`, which takes one pass over
the pixels and stores no point cloud.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from flowrep.geometry import closed_form, single_pass
from flowrep.geometry.checks import broadcast_batch, check_is_tensor, check_shape, check_trailing
from flowrep.geometry.planes import body_planes, camera_planes


class Flow(NamedTuple):
    """Flow `[*B, 2, H, W]` on the current frame's grid, with a mask of known flow.

    `valid` is bool `[*B, 1, H, W]`; flow is 0 where it is False.
    """

    flow: Tensor
    valid: Tensor


class Factors(NamedTuple):
    """Raw flow split into the camera's and the objects' share, `[*B, 2, H, W]` each.

    `valid` is bool `[*B, 1, H, W]`; where it is False, `obj` is 0 and `raw = ego + obj` need not
    hold.
    """

    ego: Tensor
    obj: Tensor
    valid: Tensor


def ego_flow(depth: Tensor, K: Tensor, prev_from_curr: Tensor, *, dt: float | Tensor = 1.0) -> Flow:
    """Returns the flow of a static world under the camera's motion.

    Convention: (p_t - p_t') / dt on the current frame's grid, t' the previous frame; u right,
    v down, pixels. If the camera drives forward, flow points outwards. Depth inf moves by rotation
    only. Flow is invalid, and 0, where depth is nan or <= 0; where the point was not in front of
    the previous camera at a hundredth of its current depth or more (closer to it, flow grows
    without bound); and everywhere if K, the motion or a tensor `dt` isn't finite, `dt` isn't
    positive or an entry is beyond 1e8. Valid flow is finite.

    Equations 7 to 11 of the paper. Floats narrower than float32 are computed in float32.

    Args:
        depth: `[*B, 1, H, W]`, metres along the optical axis.
        K: `[*B, 3, 3]`, rows (fx, skew, cx), (0, fy, cy), (0, 0, 1), pixels.
        prev_from_curr: `[*B, 4, 4]`, rigid, metres; takes a point in the current camera's frame
            into the previous camera's.
        dt: time between the frames, a number or `[*B]`; 1 gives px/step, seconds give px/s.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is not a float tensor.

    >>> K = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    >>> prev_from_curr = torch.eye(4)
    >>> prev_from_curr[0, 3] = 0.5  # the camera moved half a metre to the right
    >>> flow, valid = ego_flow(torch.full((1, 1, 2), 4.0), K, prev_from_curr)
    >>> flow[0], valid[0]  # everything moved fx * 0.5 m / 4 m = 0.5 px to the left
    (tensor([[-0.5000, -0.5000]]), tensor([[True, True]]))
    """
    batch = _check(depth, K, prev_from_curr, dt)
    dtypes = _dtypes(depth, K, prev_from_curr)
    depth = depth.expand(*batch, -1, -1, -1)
    u, v, valid = camera_planes(depth, K, prev_from_curr, dt, dtypes)
    return Flow(closed_form.stack_planes(u, v), closed_form.mask_channel(valid))


def rigid_flow(
    depth: Tensor,
    instance: Tensor,
    K: Tensor,
    prev_from_curr_by_instance: Tensor,
    *,
    dt: float | Tensor = 1.0,
) -> Flow:
    """Returns the flow of a world of rigid bodies: the simulator's exact raw flow.

    Convention: as in `ego_flow`, with one motion per instance. Row i of
    `prev_from_curr_by_instance` maps a point fixed to instance i from the current camera's frame to
    its place in the previous camera's frame; row 0 is the static world's. Where a pixel's row
    equals `prev_from_curr`, the result is bitwise equal to that of `ego_flow`. A row that isn't
    known makes only the pixels of its instance invalid.

    Args:
        depth: `[*B, 1, H, W]`, metres along the optical axis.
        instance: `[*B, 1, H, W]`, integers in [0, N), 0 for the static world.
        K: `[*B, 3, 3]`.
        prev_from_curr_by_instance: `[*B, N, 4, 4]`.
        dt: time between the frames, a number or `[*B]`.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is not a float tensor, or `instance` is not an integer tensor.
        RuntimeError: an id in `instance` without a row.

    >>> K = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    >>> motions = torch.eye(4).repeat(2, 1, 1)
    >>> motions[1, 1, 3] = -1.0  # body 1 was a metre higher: it fell
    >>> depth, instance = torch.full((1, 1, 2), 4.0), torch.tensor([[[1, 1]]])
    >>> rigid_flow(depth, instance, K, motions).flow[1]
    tensor([[2., 2.]])
    """
    motions = prev_from_curr_by_instance
    check_is_tensor("instance", instance)
    if instance.is_floating_point() or instance.is_complex() or instance.dtype == torch.bool:
        raise TypeError(f"instance must hold integer ids, got {instance.dtype}")
    check_trailing("instance", instance, (1, "H", "W"))
    check_shape("prev_from_curr_by_instance", motions, ("N", 4, 4))
    batch = _check(depth, K, motions[..., 0, :, :], dt)
    _check_same_size("instance", instance, depth)
    batch = broadcast_batch(others=batch, instance=instance.shape[:-3])
    dtypes = _dtypes(depth, K, motions)
    depth, instance = (image.expand(*batch, -1, -1, -1) for image in (depth, instance))
    u, v, valid = body_planes(depth, instance, K, motions, dt, dtypes)
    return Flow(closed_form.stack_planes(u, v), closed_form.mask_channel(valid))


def factorize(
    raw: Tensor | Flow,
    depth: Tensor,
    K: Tensor,
    prev_from_curr: Tensor,
    *,
    dt: float | Tensor = 1.0,
) -> Factors:
    """Returns raw flow split into ego flow and object flow.

    Convention: raw = ego + obj, all (p_t - p_t') / dt on the current frame's grid. Estimated flow
    from the current to the previous frame has to be negated first; flow from the previous to the
    current frame lies on the wrong grid. The result is invalid, and obj 0, where ego flow is
    invalid or raw is not finite. The factors have the widest of the arguments' float types.

    Equation 6 of the paper.

    Args:
        raw: `[*B, 2, H, W]`, pixels per dt, nan where it isn't known; or what `rigid_flow` returns,
            which says so with a mask (its flow alone, 0 there, would count as measured).
        depth: `[*B, 1, H, W]`, metres along the optical axis.
        K: `[*B, 3, 3]`.
        prev_from_curr: `[*B, 4, 4]`.
        dt: time between the frames, a number or `[*B]`; the unit of `raw` must agree.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is not a float tensor.

    >>> K = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    >>> prev_from_curr = torch.eye(4)
    >>> prev_from_curr[0, 3] = 0.5
    >>> prev_from_curr[1, 3] = 0.25
    >>> raw = torch.tensor([-0.5, 3.0]).reshape(2, 1, 1)
    >>> ego, obj, valid = factorize(raw, torch.full((1, 1, 1), 4.0), K, prev_from_curr)
    >>> ego.flatten(), obj.flatten()
    (tensor([-0.5000, -0.5000]), tensor([0.0000, 3.5000]))
    """
    if isinstance(raw, Flow):
        # Viewed as bytes, as inductor's CPU code fails to compile a `where` on a bool view.
        raw = torch.where(raw.valid.view(torch.uint8) != 0, raw.flow, math.nan)
    check_shape("raw", raw, (2, "H", "W"))
    batch = _check(depth, K, prev_from_curr, dt)
    _check_same_size("raw", raw, depth)
    batch = broadcast_batch(others=batch, raw=raw.shape[:-3])
    # Ego flow is rounded regardless of raw's dtype, so that static pixels have exactly 0 obj.
    own, compute = _dtypes(depth, K, prev_from_curr)
    dtype = torch.promote_types(own, raw.dtype)
    depth = depth.expand(*batch, -1, -1, -1)
    u, v, valid = camera_planes(depth, K, prev_from_curr, dt, (own, compute))
    raw = raw.to(dtype).expand(*batch, -1, -1, -1)
    if single_pass.suits(depth, u, v, raw):
        obj, known = single_pass.object_flow(raw, u, v, valid)
        return Factors(closed_form.stack_planes(u, v), obj, closed_form.mask_channel(known))
    raw_u, raw_v = raw.unbind(-3)
    u, v = u.to(dtype), v.to(dtype)
    obj_u, obj_v = raw_u - u, raw_v - v
    # Finite, and small enough for a finite difference.
    largest = closed_form.largest_raw(compute)
    measured = raw_u.to(compute).abs() + raw_v.to(compute).abs() < largest
    if torch.finfo(dtype).max < torch.finfo(compute).max:
        measured = measured & obj_u.isfinite() & obj_v.isfinite()
    known = valid & measured
    # When compiled, two masks in turn, because inductor would spill their conjunction to memory.
    masks = [measured, valid] if torch.compiler.is_compiling() else [known]
    for mask in masks:
        obj_u, obj_v = torch.where(mask, obj_u, 0.0), torch.where(mask, obj_v, 0.0)
    ego, obj = closed_form.stack_planes(u, v), closed_form.stack_planes(obj_u, obj_v)
    return Factors(ego, obj, closed_form.mask_channel(known))


def _check(depth: Tensor, K: Tensor, motion: Tensor, dt: float | Tensor) -> torch.Size:
    """Checks the arguments' shapes and returns their common leading batch."""
    check_shape("depth", depth, (1, "H", "W"))
    check_shape("K", K, (3, 3))
    check_shape("prev_from_curr", motion, (4, 4))
    batches = {"depth": depth.shape[:-3], "K": K.shape[:-2], "prev_from_curr": motion.shape[:-2]}
    if isinstance(dt, Tensor):
        batches["dt"] = dt.shape
    elif not closed_form.SMALLEST <= dt < math.inf:
        raise ValueError(
            "dt must be positive (current time minus previous time), at least "
            f"{closed_form.SMALLEST:g} and finite; got {dt}"
        )
    return broadcast_batch(**batches)


def _check_same_size(name: str, image: Tensor, depth: Tensor) -> None:
    """Raises ValueError if an image and depth differ in height or width."""
    if image.shape[-2:] != depth.shape[-2:]:
        raise ValueError(
            f"{name} and depth must have one (height, width), "
            f"got {list(image.shape[-2:])} and {list(depth.shape[-2:])}"
        )


def _dtypes(*tensors: Tensor) -> tuple[torch.dtype, torch.dtype]:
    """Returns the dtypes of the result (the widest) and of the computation (at least float32)."""
    dtype = tensors[0].dtype
    for tensor in tensors[1:]:
        dtype = torch.promote_types(dtype, tensor.dtype)
    return dtype, torch.promote_types(dtype, torch.float32)
