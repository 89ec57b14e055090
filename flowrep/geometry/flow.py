"""Flow that rigid motion causes, in closed form: one pass over the pixels, no point cloud.

With x~ = p - c the pixel from the principal point, K' the intrinsics without it, and
`prev_from_curr` = (R, T), the point that pixel p shows at depth Z was seen at

    p' ~ (I + A) x~ + e / Z,    A = K' (R - I) K'^-1,    e = K' T        (homogeneous)

so that with q = A x~ + e / Z the flow p - p' is (x~ qz - qx, y~ qz - qy) / (1 + qz). Nothing
large is subtracted from anything large: float32 stays an order of magnitude nearer to float64
than p - p' by the homography K R K^-1 does, and no motion gives exactly 0.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from flowrep.geometry.camera import centred_pixels
from flowrep.geometry.checks import broadcast_batch, check_is_tensor, check_shape, check_trailing


class Flow(NamedTuple):
    """Flow `[*B, 2, H, W]` on the current frame's grid, and where it is known.

    `valid` is bool `[*B, 1, H, W]`; flow is 0 where it is False.
    """

    flow: Tensor
    valid: Tensor


class Factors(NamedTuple):
    """Raw flow split in the camera's share and the objects' own, `[*B, 2, H, W]` each.

    `valid` is bool `[*B, 1, H, W]`; where it is False, `obj` is 0 and `raw = ego + obj` is not
    claimed.
    """

    ego: Tensor
    obj: Tensor
    valid: Tensor


def ego_flow(depth: Tensor, K: Tensor, prev_from_curr: Tensor, *, dt: float | Tensor = 1.0) -> Flow:
    """Returns the flow of a static world under the camera's motion.

    Convention: (p_t - p_t') / dt on the current frame's grid, t' the previous frame; u right,
    v down, pixels. A camera that drives forward sees the world stream outwards. Depth inf moves
    by rotation only. Invalid (flow 0): depth nan or <= 0, and points that were not in front of
    the previous camera.

    Equations 7 to 11 of the paper. Floats narrower than float32 are computed in float32.

    Args:
        depth: `[*B, 1, H, W]`, metres along the optical axis.
        K: `[*B, 3, 3]`, rows (fx, skew, cx), (0, fy, cy), (0, 0, 1), pixels.
        prev_from_curr: `[*B, 4, 4]`, rigid, metres; takes a point in the current camera's frame
            into the previous camera's.
        dt: time between the frames, a number or `[*B]`; 1 gives px/step, seconds give px/s.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is no float tensor.

    >>> K = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    >>> prev_from_curr = torch.eye(4)
    >>> prev_from_curr[0, 3] = 0.5  # the camera went half a metre to the right
    >>> flow, valid = ego_flow(torch.full((1, 1, 2), 4.0), K, prev_from_curr)
    >>> flow[0], valid[0]  # everything went fx * 0.5 m / 4 m = 0.5 px to the left
    (tensor([[-0.5000, -0.5000]]), tensor([[True, True]]))
    """
    batch = _check(depth, K, prev_from_curr, dt)
    dtype = _dtype(depth, K, prev_from_curr)
    coefficients = [c[..., None, None, None] for c in _coefficients(K, prev_from_curr, dtype)]
    return _cast(_flow(depth.expand(*batch, -1, -1, -1), K, coefficients, dt), dtype)


def rigid_flow(
    depth: Tensor,
    instance: Tensor,
    K: Tensor,
    prev_from_curr_by_instance: Tensor,
    *,
    dt: float | Tensor = 1.0,
) -> Flow:
    """Returns the flow of a world of rigid bodies: the simulator's exact raw flow.

    Convention: as `ego_flow`, with a motion of its own for each pixel. Row i of
    `prev_from_curr_by_instance` takes a point that rides on instance i from the current camera's
    frame to where it was in the previous camera's frame; row 0 is the static world's. Where a
    pixel's row equals `prev_from_curr`, the result is `ego_flow`'s to the last bit.

    Args:
        depth: `[*B, 1, H, W]`, metres along the optical axis.
        instance: `[*B, 1, H, W]`, integers in [0, N), 0 for the static world.
        K: `[*B, 3, 3]`.
        prev_from_curr_by_instance: `[*B, N, 4, 4]`.
        dt: time between the frames, a number or `[*B]`.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is no float tensor, or `instance` holds no integers.
        RuntimeError: an id in `instance` has no row (raised by torch).

    >>> K = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    >>> motions = torch.eye(4).repeat(2, 1, 1)
    >>> motions[1, 1, 3] = -1.0  # body 1 was a metre higher: it fell
    >>> depth, instance = torch.full((1, 1, 2), 4.0), torch.tensor([[[1, 1]]])
    >>> rigid_flow(depth, instance, K, motions).flow[1]
    tensor([[2., 2.]])
    """
    check_is_tensor("instance", instance)
    if instance.is_floating_point() or instance.is_complex() or instance.dtype == torch.bool:
        raise TypeError(f"instance must hold integer ids, got {instance.dtype}")
    check_trailing("instance", instance, (1, "H", "W"))
    check_shape("prev_from_curr_by_instance", prev_from_curr_by_instance, ("N", 4, 4))
    if instance.shape[-2:] != depth.shape[-2:]:
        raise ValueError(
            f"instance and depth must have one size, got {list(instance.shape[-2:])} "
            f"and {list(depth.shape[-2:])}"
        )
    motions = prev_from_curr_by_instance
    batch = _check(depth, K, motions[..., 0, :, :], dt)
    batch = broadcast_batch(others=batch, instance=instance.shape[:-3])
    dtype = _dtype(depth, K, motions)
    depth = depth.expand(*batch, -1, -1, -1)
    row_of_pixel = instance.long().expand(*batch, -1, -1, -1).flatten(-3)  # [*B, H*W]

    def per_pixel(by_instance: Tensor) -> Tensor:  # [*B, N] -> [*B, 1, H, W]
        rows = by_instance.expand(*batch, -1)
        return rows.gather(-1, row_of_pixel).unflatten(-1, depth.shape[-3:])

    by_instance = _coefficients(K.unsqueeze(-3), motions, dtype)
    return _cast(_flow(depth, K, [per_pixel(c) for c in by_instance], dt), dtype)


def factorize(
    raw: Tensor, depth: Tensor, K: Tensor, prev_from_curr: Tensor, *, dt: float | Tensor = 1.0
) -> Factors:
    """Returns raw flow split into ego flow and object flow.

    Convention: raw = ego + obj, all (p_t - p_t') / dt on the current frame's grid. A raw flow
    that an estimator gives from the current to the previous frame has to be negated first; one
    from the previous to the current frame lies on the wrong grid. Invalid (obj 0): where ego
    flow is invalid, and where raw is not finite.

    Equation 6 of the paper.

    Args:
        raw: `[*B, 2, H, W]`, pixels per dt.
        depth: `[*B, 1, H, W]`, metres along the optical axis.
        K: `[*B, 3, 3]`.
        prev_from_curr: `[*B, 4, 4]`.
        dt: time between the frames, a number or `[*B]`; the unit of `raw` must agree.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is no float tensor.

    >>> K = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    >>> prev_from_curr = torch.eye(4)
    >>> prev_from_curr[0, 3] = 0.5
    >>> prev_from_curr[1, 3] = 0.25
    >>> raw = torch.tensor([-0.5, 3.0]).reshape(2, 1, 1)
    >>> ego, obj, valid = factorize(raw, torch.full((1, 1, 1), 4.0), K, prev_from_curr)
    >>> ego.flatten(), obj.flatten()
    (tensor([-0.5000, -0.5000]), tensor([0.0000, 3.5000]))
    """
    check_shape("raw", raw, (2, "H", "W"))
    if raw.shape[-2:] != depth.shape[-2:]:
        raise ValueError(
            f"raw and depth must have one size, got {list(raw.shape[-2:])} "
            f"and {list(depth.shape[-2:])}"
        )
    ego, valid = ego_flow(depth, K, prev_from_curr, dt=dt)
    broadcast_batch(raw=raw.shape[:-3], others=ego.shape[:-3])
    obj = raw - ego
    u_finite, v_finite = torch.isfinite(raw).split(1, -3)
    valid = valid & u_finite & v_finite
    return Factors(ego, torch.where(valid, obj, 0.0), valid)


def _check(depth: Tensor, K: Tensor, motion: Tensor, dt: float | Tensor) -> torch.Size:
    """Returns the common leading batch of arguments whose shapes fit."""
    check_shape("depth", depth, (1, "H", "W"))
    check_shape("K", K, (3, 3))
    check_shape("prev_from_curr", motion, (4, 4))
    batches = {"depth": depth.shape[:-3], "K": K.shape[:-2], "prev_from_curr": motion.shape[:-2]}
    if isinstance(dt, Tensor):
        batches["dt"] = dt.shape
    elif not dt > 0:
        raise ValueError(f"dt must be positive (current time minus previous time), got {dt}")
    return broadcast_batch(**batches)


def _dtype(depth: Tensor, K: Tensor, motion: Tensor) -> torch.dtype:
    return torch.promote_types(torch.promote_types(depth.dtype, K.dtype), motion.dtype)


def _cast(result: Flow, dtype: torch.dtype) -> Flow:
    return Flow(result.flow.to(dtype), result.valid)


def _coefficients(K: Tensor, prev_from_curr: Tensor, dtype: torch.dtype) -> list[Tensor]:
    """Returns the twelve numbers of A (row by row) and e, each with the motion's batch.

    Written out instead of multiplied as matrices: a batched product may round differently from a
    single one, and then a body that stands still would not have the camera's flow exactly.
    """
    compute = torch.promote_types(dtype, torch.float32)
    K, motion = K.to(compute), prev_from_curr.to(compute)
    fx, skew, fy = K[..., 0, 0], K[..., 0, 1], K[..., 1, 1]
    d = [[motion[..., i, j] - float(i == j) for j in range(3)] for i in range(3)]
    tx, ty, tz = motion[..., 0, 3], motion[..., 1, 3], motion[..., 2, 3]
    rows = [
        [fx * d[0][j] + skew * d[1][j] for j in range(3)],
        [fy * d[1][j] for j in range(3)],
        d[2],
    ]  # K' (R - I)
    a = []
    for in_x, in_y, constant in rows:  # ... K'^-1
        a_x = in_x / fx
        a += [a_x, (in_y - skew * a_x) / fy, constant]
    return [*a, fx * tx + skew * ty, fy * ty, tz]


def _flow(depth: Tensor, K: Tensor, coefficients: list[Tensor], dt: float | Tensor) -> Flow:
    axx, axy, ax, ayx, ayy, ay, azx, azy, az, ex, ey, ez = coefficients
    dtype = axx.dtype
    x, y = (
        pixels.unsqueeze(-3)
        for pixels in centred_pixels(depth.shape[-2], depth.shape[-1], K.to(dtype))
    )
    has_depth = depth > 0  # nan compares False
    inverse_depth = torch.where(has_depth, depth, 1.0).to(dtype).reciprocal()  # 0 at infinity
    qx = axx * x + (axy * y + ax) + ex * inverse_depth
    qy = ayx * x + (ayy * y + ay) + ey * inverse_depth
    qz = azx * x + (azy * y + az) + ez * inverse_depth
    z_ratio = 1.0 + qz  # previous depth over current depth
    valid = has_depth & (z_ratio > 0)
    z_ratio = torch.where(valid, z_ratio, 1.0)
    if isinstance(dt, Tensor):
        z_ratio = z_ratio * dt.to(dtype)[..., None, None, None]
    elif dt != 1.0:
        z_ratio = z_ratio * dt
    flow = torch.cat([(x * qz - qx) / z_ratio, (y * qz - qy) / z_ratio], -3)
    return Flow(torch.where(valid, flow, 0.0), valid)
