"""Flow caused by rigid motion: of a static world, of moving bodies, and the difference."""

from __future__ import annotations

import math
import sys
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.autograd import forward_ad

from flowrep.extras import numba_is_installed
from flowrep.geometry import closed_form
from flowrep.geometry.checks import check_name, check_shape, common_batch
from flowrep.geometry.closed_form import as_type, widest

Direction: TypeAlias = Literal["forward", "backward"]
Grid: TypeAlias = Literal["current", "previous"]
Channels: TypeAlias = Literal["uv", "row_column"]

MAX_PIXELS_WITHOUT_NUMBA = 1 << 14  # up to here, loading numba isn't worth its second


class Flow(NamedTuple):
    """Flow `[*B, 2, H, W]` on the current frame's grid, and where it is known.

    `valid` is bool `[*B, 1, H, W]`; where it is False, flow is 0.
    """

    flow: Tensor
    valid: Tensor


class Factors(NamedTuple):
    """Raw flow split into ego flow and object flow, `[*B, 2, H, W]` each.

    `valid` is bool `[*B, 1, H, W]`; where it is False, `obj` is 0 and `raw = ego + obj` need not
    hold.
    """

    ego: Tensor
    obj: Tensor
    valid: Tensor


def ego_flow(
    depth: Tensor,
    K: Tensor,
    prev_from_curr: Tensor,
    *,
    prev_K: Tensor | None = None,
    dt: float | Tensor = 1.0,
) -> Flow:
    """Returns the flow of a static world under the camera's motion.

    Convention: (p_t - p_t') / dt on the current frame's grid, t' the previous frame; u right,
    v down, pixels. If the camera drives forward, flow points outwards. At depth inf, only rotation
    causes flow.

    Flow is 0 and invalid where depth is nan or <= 0, and where the point's depth in the previous
    camera was negative or less than a hundredth of its current depth (there, flow grows without
    bound). A whole frame is invalid if its K or its motion isn't finite or has an entry beyond 1e8,
    if a focal length is 0, or if its `dt` isn't finite or is below 1e-8. Valid flow is finite.

    Equations 7 to 11 of the paper. Floats narrower than float32 are computed in float32.

    Args:
        depth: `[*B, 1, H, W]`, metres along the optical axis.
        K: `[*B, 3, 3]`, rows (fx, skew, cx), (0, fy, cy), (0, 0, 1), pixels.
        prev_from_curr: `[*B, 4, 4]`, rigid, metres; transforms a point from the current camera's
            coordinates to the previous camera's.
        prev_K: K of the previous frame, `[*B, 3, 3]`, if it was different (zoom, autofocus).
        dt: time between the frames, a number or `[*B]`; 1 gives px/step, seconds give px/s.

    Raises:
        ValueError: a number `dt` isn't positive and finite.

    >>> K = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    >>> prev_from_curr = torch.eye(4)
    >>> prev_from_curr[0, 3] = 0.5  # the camera moved half a metre to the right
    >>> flow, valid = ego_flow(torch.full((1, 1, 2), 4.0), K, prev_from_curr)
    >>> flow[0], valid[0]  # everything moved fx * 0.5 m / 4 m = 0.5 px to the left
    (tensor([[-0.5000, -0.5000]]), tensor([[True, True]]))
    """
    batch = _check(depth, K, prev_K, prev_from_curr, dt)
    return _flow(batch, depth, None, K, prev_K, prev_from_curr.unsqueeze(-3), dt)


def rigid_flow(
    depth: Tensor,
    instance: Tensor,
    K: Tensor,
    prev_from_curr_by_instance: Tensor,
    *,
    prev_K: Tensor | None = None,
    dt: float | Tensor = 1.0,
) -> Flow:
    """Returns the flow of a world of rigid bodies: the simulator's exact raw flow.

    Convention: as in `ego_flow`, with one motion for each instance. Row i of
    `prev_from_curr_by_instance` transforms a point fixed to instance i from the current camera's
    coordinates to the previous camera's, at the previous frame; row 0 is the static world's. Where
    a pixel's row equals `prev_from_curr`, the result is bitwise equal to that of `ego_flow`. An
    unknown row (nan) makes only the pixels of its instance invalid.

    Equation 1 of the paper.

    Args:
        depth: see `ego_flow`, as for `K`, `prev_K` and `dt`.
        instance: `[*B, 1, H, W]`, integers in [0, N), 0 for the static world.
        prev_from_curr_by_instance: `[*B, N, 4, 4]`, rigid, metres.

    Raises:
        RuntimeError: an id has no row.

    >>> K = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    >>> motions = torch.eye(4).repeat(2, 1, 1)
    >>> motions[1, 1, 3] = -1.0  # body 1 was a metre higher: it fell
    >>> depth, instance = torch.full((1, 1, 2), 4.0), torch.tensor([[[1, 1]]])
    >>> rigid_flow(depth, instance, K, motions).flow[1]
    tensor([[2., 2.]])
    """
    motions = prev_from_curr_by_instance
    check_shape("instance", instance, (1, "H", "W"), ids=True)
    check_shape("prev_from_curr_by_instance", motions, ("N", 4, 4))
    batch = _check(depth, K, prev_K, motions[..., 0, :, :], dt, instance=instance)
    return _flow(batch, depth, instance, K, prev_K, motions, dt)


def factorize(
    raw: Tensor | Flow,
    depth: Tensor,
    K: Tensor,
    prev_from_curr: Tensor,
    *,
    prev_K: Tensor | None = None,
    dt: float | Tensor = 1.0,
) -> Factors:
    """Returns raw flow split into ego flow and object flow.

    Convention: raw = ego + obj, all (p_t - p_t') / dt on the current frame's grid. Flow estimated
    from the current to the previous frame has to be negated first; flow from the previous to the
    current frame is on the wrong grid (see `adapt_flow`). The result is invalid, and obj 0, where
    ego flow is invalid or raw is not finite. The factors have the widest of the arguments' float
    types.

    Equation 6 of the paper.

    Args:
        raw: `[*B, 2, H, W]`, pixels per dt, nan where it is unknown; or the `Flow` of `rigid_flow`
            with its mask. (Without the mask, the 0 of unknown pixels would count as measured.)
        depth: see `ego_flow`, as for `K`, `prev_from_curr` and `prev_K`.
        dt: see `ego_flow`; the unit of `raw` must agree.

    >>> K = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    >>> prev_from_curr = torch.eye(4)
    >>> prev_from_curr[0, 3] = 0.5
    >>> prev_from_curr[1, 3] = 0.25
    >>> raw = torch.tensor([-0.5, 3.0]).reshape(2, 1, 1)
    >>> ego, obj, valid = factorize(raw, torch.full((1, 1, 1), 4.0), K, prev_from_curr)
    >>> ego.flatten(), obj.flatten()
    (tensor([-0.5000, -0.5000]), tensor([0.0000, 3.5000]))
    """
    raw, raw_known = raw if isinstance(raw, Flow) else (raw, None)
    check_shape("raw", raw, (2, "H", "W"))
    batch = _check(depth, K, prev_K, prev_from_curr, dt, raw=raw)
    if _suits_numba(depth, K, prev_K, prev_from_curr, dt, raw):
        from flowrep.geometry import numba_flow  # needs numba

        given: Any = {"raw": raw, "raw_known": raw_known, "camera": prev_from_curr}
        return Factors(*numba_flow.planes(batch, depth, K, prev_K, dt, **given)[2:])
    if raw_known is not None:
        # Viewed as bytes, because inductor's CPU code can't compile a `where` on a bool view.
        raw = torch.where(raw_known.view(torch.uint8) != 0, raw, math.nan)
    # Ego flow is rounded as in `rigid_flow`, whatever raw's dtype, so that static obj is exactly 0.
    u, v, valid = closed_form.planes(
        batch, depth, None, K, prev_K, prev_from_curr.unsqueeze(-3), dt
    )
    dtype, compute = widest(u.dtype, raw.dtype), widest(u.dtype, torch.float32)
    raw = as_type(raw, dtype).expand(*batch, -1, -1, -1)
    raw_u, raw_v = raw.unbind(-3)
    u, v = as_type(u, dtype), as_type(v, dtype)
    # Finite, and small enough for a finite difference.
    largest = closed_form.largest_raw(compute)
    measured = as_type(raw_u, compute).abs() + as_type(raw_v, compute).abs() < largest
    if torch.finfo(dtype).max < torch.finfo(compute).max:
        measured = measured & (raw_u - u).isfinite() & (raw_v - v).isfinite()
    ego, known = closed_form.stack_planes(u, v), closed_form.mask_channel(valid & measured)
    if not torch.compiler.is_compiling():
        return Factors(ego, torch.where(known, raw - ego, 0.0), known)
    # When compiled, apply the two masks in turn to each plane. Inductor would write their
    # conjunction to memory, as bools one lane at a time, and take ten times as long.
    planes = [
        torch.where(valid, torch.where(measured, of_raw - of_ego, 0.0), 0.0)
        for of_raw, of_ego in ((raw_u, u), (raw_v, v))
    ]
    return Factors(ego, closed_form.stack_planes(*planes), known)


def rigid_factors(
    depth: Tensor,
    instance: Tensor,
    K: Tensor,
    prev_from_curr_by_instance: Tensor,
    prev_from_curr: Tensor,
    *,
    prev_K: Tensor | None = None,
) -> tuple[Flow, Factors]:
    """Returns `rigid_flow` and its factors by `factorize`; shapes must be right, with one batch."""
    motions = prev_from_curr_by_instance
    if _suits_numba(depth, K, prev_K, motions, prev_from_curr):
        from flowrep.geometry import numba_flow  # needs numba

        given: Any = {"instance": instance, "motions": motions, "camera": prev_from_curr}
        planes = numba_flow.planes(depth.shape[:-3], depth, K, prev_K, 1.0, **given)
        return Flow(*planes[:2]), Factors(*planes[2:])
    raw = rigid_flow(depth, instance, K, motions, prev_K=prev_K)
    return raw, factorize(raw, depth, K, prev_from_curr, prev_K=prev_K)


def adapt_flow(
    flow: Tensor, *, direction: Direction, grid: Grid, channels: Channels = "uv"
) -> Tensor:
    """Returns flow p_t - p_t' on the current frame's grid, (u right, v down), `[*B, 2, H, W]`.

    Convention: `direction` is that of the vectors: `"forward"` is p_t - p_t', from a point's
    previous to its current position; `"backward"` is p_t' - p_t. `grid` is the frame whose pixels
    the vectors belong to. An estimator called with (current, previous) gives backward flow on the
    current grid.

    Args:
        flow: `[*B, 2, H, W]`, pixels.
        direction: `"forward"` or `"backward"`.
        grid: `"current"`; `"previous"` raises ValueError.
        channels: `"uv"` (column first) or `"row_column"`.

    Raises:
        ValueError: the grid is the previous frame's. Its pixels have moved, several of them to the
            same pixel and none to others, so flow on the current grid would be a guess.

    >>> flow = torch.tensor([3.0, -2.0]).reshape(2, 1, 1)  # it was 3 rows down, 2 columns left
    >>> adapt_flow(flow, direction="backward", grid="current", channels="row_column").flatten()
    tensor([ 2., -3.])
    """
    check_name("direction", direction, Direction)
    check_name("grid", grid, Grid)
    check_name("channels", channels, Channels)
    if grid == "previous":
        raise ValueError(
            f"{direction} flow on the previous frame's grid can't be converted exactly to the "
            "current frame's grid: pixels that were covered have no vector, and where several move "
            "to the same pixel, depth decides which one is seen. Compute flow from the current "
            "frame to the previous one (with most estimators: swap the two pictures) and adapt it "
            "with direction='backward', grid='current'"
        )
    check_shape("flow", flow, (2, "H", "W"))
    if channels == "row_column":
        flow = flow.flip(-3)
    return -flow if direction == "backward" else flow


def _check(
    depth: Tensor,
    K: Tensor,
    prev_K: Tensor | None,
    motion: Tensor,
    dt: float | Tensor,
    **image: Tensor,
) -> torch.Size:
    """Checks the arguments' shapes and returns their common leading batch."""
    check_shape("depth", depth, (1, "H", "W"))
    check_shape("K", K, (3, 3))
    check_shape("prev_from_curr", motion, (4, 4))
    batches = {"depth": depth.shape[:-3], "K": K.shape[:-2], "prev_from_curr": motion.shape[:-2]}
    if prev_K is not None:
        check_shape("prev_K", prev_K, (3, 3))
        batches["prev_K"] = prev_K.shape[:-2]
    for name, other in image.items():
        batches[name] = other.shape[:-3]
        if other.shape[-2:] != depth.shape[-2:]:
            raise ValueError(
                f"{name} and depth must have one (height, width), "
                f"got {list(other.shape[-2:])} and {list(depth.shape[-2:])}"
            )
    if isinstance(dt, Tensor):
        batches["dt"] = dt.shape
    elif not closed_form.LEAST_POSITIVE <= dt < math.inf:
        raise ValueError(
            "dt must be positive (current time minus previous time), at least "
            f"{closed_form.LEAST_POSITIVE:g} and finite; got {dt}"
        )
    return common_batch(**batches)


def _flow(
    batch: torch.Size,
    depth: Tensor,
    instance: Tensor | None,
    K: Tensor,
    prev_K: Tensor | None,
    motions: Tensor,
    dt: float | Tensor,
) -> Flow:
    """Returns the flow of one motion per instance, `[*B, N, 4, 4]`; without ids, of the first."""
    if _suits_numba(depth, K, prev_K, motions, dt):
        from flowrep.geometry import numba_flow  # needs numba

        given: Any = {"motions": motions, "instance": instance}
        return Flow(*numba_flow.planes(batch, depth, K, prev_K, dt, **given)[:2])
    u, v, valid = closed_form.planes(batch, depth, instance, K, prev_K, motions, dt)
    return Flow(closed_form.stack_planes(u, v), closed_form.mask_channel(valid))


def _suits_numba(depth: Tensor, *others: float | Tensor | None) -> bool:
    """Returns whether `numba_flow` can and should compute: float32, CPU, no grad."""
    # This comes first, because a branch on sizes would make compiled code recompile for other
    # sizes.
    if torch.compiler.is_compiling():
        return False
    tensors = [depth, *(other for other in others if isinstance(other, Tensor))]
    return (
        depth.is_cpu
        and ("numba" in sys.modules or depth.numel() > MAX_PIXELS_WITHOUT_NUMBA)
        and all(tensor.dtype is torch.float32 and _is_plain(tensor) for tensor in tensors)
        and numba_is_installed()
    )


def _is_plain(tensor: Tensor) -> bool:
    """Returns whether a tensor is plain numbers in memory, which numpy can view.

    Subclasses, tensors within `torch.func`'s transforms and dual tensors are not.
    """
    if type(tensor) not in (Tensor, torch.nn.Parameter):
        return False
    if tensor.requires_grad and torch.is_grad_enabled():
        return False
    try:
        tensor.data_ptr()
    except RuntimeError:  # in torch.func's vmap, grad or jvp a tensor has no memory of its own
        return False
    return forward_ad.unpack_dual(tensor).tangent is None
