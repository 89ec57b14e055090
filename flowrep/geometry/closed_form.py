"""The closed form behind the flow functions, which compiles to a single pass over the pixels.

`numba_flow` computes the same, bit for bit: change both.

With x~ = p - c the pixel relative to the principal point c, K' the intrinsics without it, and
`prev_from_curr` = (R, T), the point that pixel p shows at depth Z was seen at

    p' ~ (I + A) x~ + e / Z,    A = K' (R - I) K'^-1,    e = K' T        (homogeneous)

relative to c. If the previous frame had other intrinsics K_p, with M those relative to c too
(principal point c_p - c), it was at

    A = (M (R - I) + K_p - K) K'^-1,    e = M T

so that with q = A x~ + e / Z the flow p - p' is (x~ qz - qx, y~ qz - qy) / (1 + qz). This never
subtracts two large numbers. The float32 result is therefore ten times as accurate as p - p' from
the homography K R K^-1, and without motion flow is exactly 0.

1 + qz is the point's depth in the previous camera divided by that in the current one. As this ratio
falls to 0, flow grows without bound, so flow is valid only if the ratio is above `MIN_DEPTH_RATIO`.

Valid flow is finite, and no pixel has to be checked for that: the bounds below exclude inputs for
which an intermediate result could overflow in float32 (the worst case is 3e34, the limit 3e38).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from flowrep.geometry.camera import centred_pixels
from flowrep.geometry.checks import check_rows

# Lower bound on the depth in the previous camera divided by the depth in the current one.
MIN_DEPTH_RATIO = 0.01

# Bounds on valid input, far beyond any camera's values. Within them nothing overflows in float32.
LARGEST = 1e8  # of the entries of K, A and e: pixels, metres and their products
LEAST_POSITIVE = 1e-8  # of depth in metres, and of dt

Planes = tuple[Tensor, Tensor, Tensor]  # u, v, valid: [*B, H, W] each


def widest(*dtypes: torch.dtype) -> torch.dtype:
    """Returns the type that all types can be converted to."""
    return functools.reduce(torch.promote_types, dict.fromkeys(dtypes))


def as_type(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """Returns a tensor of a type; without a call of PyTorch if it has it, for single frames."""
    return tensor if tensor.dtype is dtype else tensor.to(dtype)


def planes(
    batch: torch.Size,
    depth: Tensor,
    instance: Tensor | None,
    K: Tensor,
    prev_K: Tensor | None,
    motions: Tensor,
    dt: float | Tensor,
) -> Planes:
    """Returns the flow of one motion per instance, `[*B, N, 4, 4]`; without ids, of the first."""
    height, width = depth.shape[-2:]
    dtype = widest(*(x.dtype for x in (depth, K, prev_K, motions) if x is not None))
    compute = widest(dtype, torch.float32)
    K, dt, known = known_camera(as_type(K, compute), dt)
    if prev_K is not None:
        prev_K, _, prev_known = known_camera(as_type(prev_K, compute), 1.0)
        prev_K, known = prev_K.unsqueeze(-3), known & prev_known
    by_motion = motion_coefficients(
        K.unsqueeze(-3), prev_K, as_type(motions, compute), known.unsqueeze(-1)
    )  # [*B, N, 12]
    x, y = centred_pixels(height, width, K)
    depth = depth.squeeze(-3).expand(*batch, height, width)
    if instance is not None:
        instance = instance.squeeze(-3).expand(*batch, -1, -1)
    if instance is None:
        each = list(by_motion.unsqueeze(-2).unbind(-1))  # [*B, 1, 1]
    else:
        each = _of_pixels(by_motion, instance)
    e = each[9:]
    # q at infinity is A x~, which is affine in x and y: one term per column plus one per row.
    columns = [a_x * x for a_x in each[:3]]
    rows = [a_y * y + constant for a_y, constant in zip(each[3:6], each[6:9])]
    # Without ids, each term has W or H values instead of H · W.
    if instance is None and torch.compiler.is_compiling():
        x, *columns = _slices_of_one(x, *columns)
        y, *rows = _slices_of_one(y, *rows)
    q_far = [column + row for column, row in zip(columns, rows)]
    if isinstance(dt, Tensor):
        dt = dt[..., None, None]
    return flow_planes(depth, x, y, q_far, e, dt, dtype)


def _of_pixels(by_motion: Tensor, instance: Tensor) -> list[Tensor]:
    """Returns the twelve coefficients `[*B, H, W]` of each pixel's motion."""
    *batch, height, width = instance.shape
    at = instance.long().flatten(-2).unsqueeze(-2)
    rows = by_motion.mT.expand(*batch, -1, -1)  # [*B, 12, N]
    # One by one, inductor's code is a tenth faster; all at once, a single frame's.
    parts = rows.split(1, -2) if torch.compiler.is_compiling() else [rows]
    try:
        each = [part.gather(-1, at.expand(*batch, part.shape[-2], -1)) for part in parts]
        return [x for planes in each for x in planes.unflatten(-1, (height, width)).unbind(-3)]
    except RuntimeError:
        check_rows(int(instance.min()), int(instance.max()), by_motion.shape[-2])
        raise


def _slices_of_one(*entries: Tensor) -> tuple[Tensor, ...]:
    """Returns the entries as slices of one tensor.

    Inductor stores stacked entries. Otherwise it would compute them again at every pixel, which
    takes 1.7 times as long.
    """
    return torch.stack(torch.broadcast_tensors(*entries)).unbind()


def known_camera(K: Tensor, dt: float | Tensor) -> tuple[Tensor, float | Tensor, Tensor]:
    """Returns K and dt with invalid values replaced, and where they were valid, `[*B]`.

    A mask alone would not keep nan out of gradients.
    """
    known = _within_bounds(K, (-2, -1)) & (K[..., :2, :2].diagonal(dim1=-2, dim2=-1) != 0).all(-1)
    K = K.masked_fill(~known[..., None, None], 1.0)
    if isinstance(dt, Tensor):
        dt = dt.to(K.dtype)
        runs = dt.isfinite() & (dt >= LEAST_POSITIVE)
        dt, known = torch.where(runs, dt, 1.0), known & runs
    return K, dt, known


def _within_bounds(tensor: Tensor, dims: tuple[int, ...]) -> Tensor:
    """Returns where all entries along `dims` are finite and at most `LARGEST`."""
    return (tensor.abs() <= LARGEST).all(dims)  # nan compares False


def motion_coefficients(
    K: Tensor, prev_K: Tensor | None, prev_from_curr: Tensor, known: Tensor
) -> Tensor:
    """Returns A (column by column) and e, `[*B, 12]`; without `prev_K` the previous K is the same.

    If an input is unknown, the coefficients place every point behind the previous camera. No pixel
    is then valid, and pixels need no separate check.

    The products are written out because a batched matrix product may round differently from a
    single one, and a static body's flow would then differ from the camera's.
    """
    bounded = _within_bounds(prev_from_curr, (-2, -1))
    motion = prev_from_curr.masked_fill(~bounded[..., None, None], 0.0)[..., :3, :]
    x, y, z = (motion - torch.eye(3, 4, dtype=motion.dtype, device=motion.device)).unbind(-2)
    fx, skew, fy = _focal(K)
    fx_p, skew_p, fy_p = (fx, skew, fy) if prev_K is None else _focal(prev_K)
    x, y = fx_p * x + skew_p * y, fy_p * y  # M (R - I | T), of which z is the third row
    if prev_K is not None:
        change = torch.nn.functional.pad(prev_K - K, (0, 1))
        x, y = (row + change[..., i, 2:3] * z for i, row in enumerate((x, y)))
        x, y = x + change[..., 0, :], y + change[..., 1, :]
    in_x, in_y, constant, e = torch.stack((x, y, z.expand_as(x)), -2).unbind(-1)
    a_x = in_x / fx  # ... K'^-1
    a_y = (in_y - skew * a_x) / fy
    coefficients = torch.cat([a_x, a_y, constant, e], -1)
    known = (known & bounded & _within_bounds(coefficients, (-1,))).unsqueeze(-1)
    behind = (0.0, -2.0, 0.0)  # 1 + qz = -1
    # Concatenated, so that inductor stores the twelve numbers. It would fuse a single `where`
    # with the code that reads them and repeat it at every pixel, and `factorize` would take 1.4 to
    # 1.7 times as long.
    parts = zip((coefficients[..., :8], coefficients[..., 8:9], coefficients[..., 9:]), behind)
    return torch.cat([torch.where(known, part, otherwise) for part, otherwise in parts], -1)


def _focal(K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns fx, skew and fy, `[*B, 1]` each."""
    first, second, _ = K.unbind(-2)
    return first[..., :1], first[..., 1:2], second[..., 1:2]


def flow_planes(
    depth: Tensor,
    x: Tensor,
    y: Tensor,
    q_far: Sequence[Tensor],
    e: Sequence[Tensor],
    dt: float | Tensor,
    dtype: torch.dtype,
) -> Planes:
    """Returns u, v and valid of depth's shape; q is `q_far` at infinity.

    Depth is `[*B, H, W]`; all other arguments broadcast with it.
    """
    depth = as_type(depth, x.dtype)
    has_depth = depth >= LEAST_POSITIVE  # nan compares False
    # The result is masked in any case. For gradients, the inputs of both divisions must be masked
    # as well, because the derivative of an unused branch is 0 · inf = nan. Eager code without
    # gradients skips these two passes. Compiled code must accept any input, and fuses them.
    has_gradient = any(tensor.requires_grad for tensor in (depth, x, y, *q_far, *e))
    is_masked = has_gradient or torch.compiler.is_compiling()
    inverse_depth = (torch.where(has_depth, depth, 1.0) if is_masked else depth).reciprocal()
    qx, qy, qz = (far + near * inverse_depth for far, near in zip(q_far, e))
    z_ratio = 1.0 + qz  # depth in the previous camera divided by depth in the current one
    in_front = has_depth & (z_ratio > MIN_DEPTH_RATIO)
    per_z = (torch.where(in_front, z_ratio, 1.0) if is_masked else z_ratio).reciprocal()
    # Of geometry's callers alone, who know seconds; a transform's flow is per step times `scale`.
    if isinstance(dt, Tensor) or dt != 1.0:
        per_z = per_z / dt
    u = as_type((x * qz - qx) * per_z, dtype)
    v = as_type((y * qz - qy) * per_z, dtype)
    valid = in_front
    # Computed in float32 or float64, but perhaps returned as float16, whose limit is 65,504.
    if torch.finfo(dtype).max < torch.finfo(x.dtype).max:
        valid = valid & u.isfinite() & v.isfinite()
    return torch.where(valid, u, 0.0), torch.where(valid, v, 0.0), valid


def stack_planes(u: Tensor, v: Tensor) -> Tensor:
    """Returns `[*B, 2, H, W]` from `[*B, H, W]` planes.

    It concatenates the planes along the rows and splits the result. With torch.stack, inductor
    interleaves the channels, which takes 5 to 20 % longer.
    """
    *batch, height, width = u.shape
    return torch.cat([u, v], -2).view(*batch, 2, height, width)


def mask_channel(valid: Tensor) -> Tensor:
    """Returns bool `[*B, 1, H, W]` from a `[*B, H, W]` plane.

    Inductor's CPU code stores bools one lane at a time, and `factorize` would take 5 to 10 times as
    long (torch 2.13). When compiled, the mask is therefore written as bytes and viewed as bool.
    as_strided changes nothing, but makes inductor write the bytes before the view.
    """
    if torch.compiler.is_compiling():
        ones = torch.where(valid, 1.0, 0.0).to(torch.uint8)
        valid = ones.as_strided(ones.shape, ones.stride()).view(torch.bool)
    return valid.unsqueeze(-3)


def largest_raw(compute: torch.dtype) -> float:
    """Returns the bound on |u| + |v| of raw flow, from which ego flow can be subtracted."""
    return torch.finfo(compute).max / 4
