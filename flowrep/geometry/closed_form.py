"""The closed form behind the flow functions, which compiles to a single pass over the pixels.

With x~ = p - c the pixel relative to the principal point c, K' the intrinsics without it, and
`prev_from_curr` = (R, T), the point that pixel p shows at depth Z was seen at

    p' ~ (I + A) x~ + e / Z,    A = K' (R - I) K'^-1,    e = K' T        (homogeneous)

relative to c. If the previous frame had other intrinsics K_p, with M those relative to c too
(principal point c_p - c), it was at

    A = (M (R - I) + K_p - K) K'^-1,    e = M T

so that with q = A x~ + e / Z the flow p - p' is (x~ qz - qx, y~ qz - qy) / (1 + qz). No two large
numbers are subtracted: the float32 result is an order of magnitude closer to float64 than p - p'
computed with the homography K R K^-1, and without motion flow is exactly 0.

1 + qz is the point's depth in the previous camera over that in the current one. Flow grows without
bound as it falls to 0, so a pixel counts as seen before only if it is above `MIN_DEPTH_RATIO`.

Valid flow is finite, without a check per pixel: the bounds below exclude inputs for which an
intermediate result could overflow in float32, which ends at 3e38 (the worst case reaches 3e34).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

# Lower bound on the depth in the previous camera over the depth in the current one.
MIN_DEPTH_RATIO = 0.01

# Bounds on what is accepted, far beyond any camera's: within them nothing overflows in float32.
LARGEST = 1e8  # of the entries of K, A and e: pixels, metres and their products
SMALLEST = 1e-8  # of depth in metres, and of dt

Planes = tuple[Tensor, Tensor, Tensor]  # u, v, valid: [*B, H, W] each


def known_camera(K: Tensor, dt: float | Tensor) -> tuple[Tensor, float | Tensor, Tensor]:
    """Returns K and dt with invalid values replaced, and where they were valid, `[*B]`.

    They are replaced, not only masked, to keep nan out of gradients.
    """
    known = _within_bounds(K, (-2, -1)) & (K[..., 0, 0] != 0) & (K[..., 1, 1] != 0)
    K = torch.where(known[..., None, None], K, torch.eye(3, dtype=K.dtype, device=K.device))
    if isinstance(dt, Tensor):
        dt = dt.to(K.dtype)
        runs = dt.isfinite() & (dt >= SMALLEST)
        dt, known = torch.where(runs, dt, 1.0), known & runs
    return K, dt, known


def _within_bounds(tensor: Tensor, dims: tuple[int, ...]) -> Tensor:
    """Returns where all entries along `dims` are finite and at most `LARGEST`."""
    return (tensor.abs() <= LARGEST).all(dims)  # nan compares False


def motion_coefficients(
    K: Tensor, prev_K: Tensor | None, prev_from_curr: Tensor, known: Tensor
) -> Tensor:
    """Returns A (row by row) and e, `[*B, 12]`; without `prev_K` the previous K is the same.

    Where an input isn't known, they place every point behind the previous camera, so that no pixel
    is valid, without a check per pixel.

    The products are written out because a batched matrix product may round differently from a
    single one, and a static body would then not have exactly the camera's flow.
    """
    bounded = _within_bounds(prev_from_curr, (-2, -1))
    motion = torch.where(bounded[..., None, None], prev_from_curr, 0.0)
    fx, skew, fy = _focal(K)
    d = [[motion[..., i, j] - float(i == j) for j in range(3)] for i in range(3)]  # R - I
    t = [motion[..., i, 3] for i in range(3)]
    fx_p, skew_p, fy_p = (fx, skew, fy) if prev_K is None else _focal(prev_K)
    columns = [[fx_p * x + skew_p * y, fy_p * y, z] for x, y, z in (*zip(*d), t)]  # M (R - I | T)
    if prev_K is not None:
        change = prev_K - K
        right, down = change[..., :2, 2].unbind(-1)
        columns = [[x + right * z, y + down * z, z] for x, y, z in columns]
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)):
            columns[j][i] = columns[j][i] + change[..., i, j]
    *rows, e = *zip(*columns[:3]), columns[3]
    a = []
    for in_x, in_y, constant in rows:  # ... K'^-1
        a_x = in_x / fx
        a += [a_x, (in_y - skew * a_x) / fy, constant]
    coefficients = torch.stack(torch.broadcast_tensors(*a, *e), -1)
    known = (known & bounded & _within_bounds(coefficients, (-1,))).unsqueeze(-1)
    behind = (0.0, -2.0, 0.0)  # 1 + qz = -1
    # Concatenated, so that inductor stores the twelve numbers. A single `where` it would fuse with
    # what reads them, and repeat at every pixel: 1.4 to 1.7 times the time of `factorize`.
    parts = zip(coefficients.split([8, 1, 3], -1), behind)
    return torch.cat([torch.where(known, part, otherwise) for part, otherwise in parts], -1)


def _focal(K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns fx, skew and fy."""
    return K[..., 0, 0], K[..., 0, 1], K[..., 1, 1]


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
    depth = depth.to(x.dtype)
    has_depth = depth >= SMALLEST  # nan compares False
    # The result is masked in any case. Gradients need the inputs of both divisions masked as well:
    # the derivative of an unused branch is 0 · inf = nan. Eager code without gradients saves these
    # two passes; compiled code, which takes any input, fuses them.
    has_gradient = any(tensor.requires_grad for tensor in (depth, x, y, *q_far, *e))
    is_masked = has_gradient or torch.compiler.is_compiling()
    inverse_depth = (torch.where(has_depth, depth, 1.0) if is_masked else depth).reciprocal()
    qx, qy, qz = (far + near * inverse_depth for far, near in zip(q_far, e))
    z_ratio = 1.0 + qz  # depth in the previous camera over depth in the current one
    in_front = has_depth & (z_ratio > MIN_DEPTH_RATIO)
    per_z = (torch.where(in_front, z_ratio, 1.0) if is_masked else z_ratio).reciprocal()
    if isinstance(dt, Tensor) or dt != 1.0:
        per_z = per_z / dt
    u = ((x * qz - qx) * per_z).to(dtype)
    v = ((y * qz - qy) * per_z).to(dtype)
    valid = in_front
    # Computed in float32 or float64 but returned as float16, which ends at 65,504.
    if torch.finfo(dtype).max < torch.finfo(x.dtype).max:
        valid = valid & u.isfinite() & v.isfinite()
    return torch.where(valid, u, 0.0), torch.where(valid, v, 0.0), valid


def stack_planes(u: Tensor, v: Tensor) -> Tensor:
    """Returns `[*B, 2, H, W]` from `[*B, H, W]` planes.

    Concatenated along the rows and split. torch.stack makes inductor interleave the channels, which
    takes 5 to 20 % longer.
    """
    return torch.cat([u, v], -2).unflatten(-2, (2, -1))


def mask_channel(valid: Tensor) -> Tensor:
    """Returns bool `[*B, 1, H, W]` from a `[*B, H, W]` plane.

    When compiled, the mask is written as bytes and then viewed as bool, as inductor's CPU code
    stores bools one lane at a time: `factorize` would take 5 to 10 times as long (torch 2.13).
    as_strided, which changes nothing, makes inductor write the bytes before the view.
    """
    if torch.compiler.is_compiling():
        ones = torch.where(valid, 1.0, 0.0).to(torch.uint8)
        valid = ones.as_strided(ones.shape, ones.stride()).view(torch.bool)
    return valid.unsqueeze(-3)


def largest_raw(compute: torch.dtype) -> float:
    """Returns the bound on |u| + |v| of raw flow, from which ego flow can be subtracted."""
    return torch.finfo(compute).max / 4
