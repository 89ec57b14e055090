"""The closed form behind the flow functions, written so that compiled it is one pass.

With x~ = p - c the pixel from the principal point, K' the intrinsics without it, and
`prev_from_curr` = (R, T), the point that pixel p shows at depth Z was seen at

    p' ~ (I + A) x~ + e / Z,    A = K' (R - I) K'^-1,    e = K' T        (homogeneous)

so that with q = A x~ + e / Z the flow p - p' is (x~ qz - qx, y~ qz - qy) / (1 + qz). Nothing
large is subtracted from anything large: float32 stays an order of magnitude nearer to float64
than p - p' by the homography K R K^-1 does, and no motion gives exactly 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from flowrep.geometry.camera import centred_pixels

Planes = tuple[Tensor, Tensor, Tensor]  # u, v, valid: [*B, H, W] each


def camera_planes(
    depth: Tensor, K: Tensor, prev_from_curr: Tensor, dt: float | Tensor, dtype: torch.dtype
) -> Planes:
    """Returns the flow planes of one motion for the whole image."""
    by_motion = _coefficients(K, prev_from_curr, dtype)[..., None, None, :]  # [*B, 1, 1, 12]
    axx, axy, ax, ayx, ayy, ay, azx, azy, az, *e = by_motion.unbind(-1)
    x, y = centred_pixels(depth.shape[-2], depth.shape[-1], K.to(dtype))
    # A x~ is a column's share plus a row's. Tables of them leave each pixel an addition.
    x, *columns = _table(x, axx * x, ayx * x, azx * x)
    y, *rows = _table(y, axy * y + ax, ayy * y + ay, azy * y + az)
    q_far = [column + row for column, row in zip(columns, rows)]
    return _planes(depth, x, y, q_far, e, dt)


def body_planes(
    depth: Tensor,
    instance: Tensor,
    K: Tensor,
    prev_from_curr_by_instance: Tensor,
    dt: float | Tensor,
    dtype: torch.dtype,
) -> Planes:
    """Returns the flow planes of a motion for each instance, `depth` and `instance` in batch."""
    *batch, _, height, width = depth.shape
    row_of_pixel = instance.long().flatten(-3)  # [*B, H * W]
    by_instance = _coefficients(K.unsqueeze(-3), prev_from_curr_by_instance, dtype)  # [*B, N, 12]
    axx, axy, ax, ayx, ayy, ay, azx, azy, az, *e = (
        rows.expand(*batch, -1).gather(-1, row_of_pixel).unflatten(-1, (height, width))
        for rows in by_instance.unbind(-1)
    )
    x, y = centred_pixels(height, width, K.to(dtype))
    # The same operations in the same order as camera_planes: equal motions give equal bits.
    q_far = [
        axx * x + (axy * y + ax),
        ayx * x + (ayy * y + ay),
        azx * x + (azy * y + az),
    ]
    return _planes(depth, x, y, q_far, e, dt)


def _coefficients(K: Tensor, prev_from_curr: Tensor, dtype: torch.dtype) -> Tensor:
    """Returns A (row by row) and e, `[*B, 12]`.

    Written out instead of multiplied as matrices: a batched product may round differently from a
    single one, and then a body that stands still would not have the camera's flow exactly.
    """
    K, motion = K.to(dtype), prev_from_curr.to(dtype)
    fx, skew, fy = K[..., 0, 0], K[..., 0, 1], K[..., 1, 1]
    d = [[motion[..., i, j] - float(i == j) for j in range(3)] for i in range(3)]  # R - I
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
    e = [fx * tx + skew * ty, fy * ty, tz]
    return torch.stack(torch.broadcast_tensors(*a, *e), -1)


def _table(*entries: Tensor) -> tuple[Tensor, ...]:
    """Returns the entries as slices of one tensor, which inductor keeps instead of recomputing."""
    return torch.stack(torch.broadcast_tensors(*entries)).unbind()


def _planes(
    depth: Tensor,
    x: Tensor,
    y: Tensor,
    q_far: Sequence[Tensor],
    e: Sequence[Tensor],
    dt: float | Tensor,
) -> Planes:
    """Returns u, v and valid, from depth `[*B, 1, H, W]`; q is `q_far` at infinity."""
    depth = depth.squeeze(-3)
    has_depth = depth > 0  # nan compares False
    # Masked before and after each division, so that no gradient meets a nan.
    inverse_depth = torch.where(has_depth, depth, 1.0).to(x.dtype).reciprocal()  # 0 at infinity
    qx, qy, qz = (far + near * inverse_depth for far, near in zip(q_far, e))
    z_ratio = 1.0 + qz  # depth in the previous camera over depth in the current one
    valid = has_depth & (z_ratio > 0)
    per_z = torch.where(valid, z_ratio, 1.0).reciprocal()
    if isinstance(dt, Tensor):
        per_z = per_z / dt.to(x.dtype)[..., None, None]
    elif dt != 1.0:
        per_z = per_z / dt
    u = torch.where(valid, (x * qz - qx) * per_z, 0.0)
    v = torch.where(valid, (y * qz - qy) * per_z, 0.0)
    return u, v, valid


def stack_planes(u: Tensor, v: Tensor) -> Tensor:
    """Returns `[*B, 2, H, W]` from `[*B, H, W]` planes.

    Joined along the rows and split again: torch.stack makes inductor interleave the channels.
    """
    return torch.cat([u, v], -2).unflatten(-2, (2, -1))


def mask_channel(valid: Tensor) -> Tensor:
    """Returns bool `[*B, 1, H, W]` from a `[*B, H, W]` plane.

    Compiled, the mask is written as bytes and then read as bool: inductor's CPU code stores a
    bool a lane at a time, which took three quarters of the whole pass. as_strided is what makes
    it write the bytes before it renames them.
    """
    if torch.compiler.is_compiling():
        ones = torch.where(valid, 1.0, 0.0).to(torch.uint8)
        valid = ones.as_strided(ones.shape, ones.stride()).view(torch.bool)
    return valid.unsqueeze(-3)
