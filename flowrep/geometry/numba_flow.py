"""Flow of large maps on a CPU in a single pass over the pixels; importing this needs numba.

PyTorch needs about twenty passes through memory for `closed_form.flow_planes`: 11.3 ms for a step
of 96 envs at 84 × 84, where these kernels take 3.7 ms. They do the same operations in the same
order, each rounded to float32, so that the results are bitwise equal. If you change one, change the
other. `flow` decides which maps are computed here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flowrep.extras import compiled
from flowrep.geometry.checks import check_rows
from flowrep.geometry.closed_form import LEAST_POSITIVE, MIN_DEPTH_RATIO, Planes, largest_raw

# numpy's float32 scalars: a Python float would make numba compute in float64.
_LEAST_DEPTH, _LEAST_RATIO = np.float32(LEAST_POSITIVE), np.float32(MIN_DEPTH_RATIO)
_LARGEST_RAW = np.float32(largest_raw(torch.float32))
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)

# "numpy": a division by 0 gives inf, as in PyTorch, without a branch that raises. No fastmath: it
# may fuse or reorder operations, and the last bits would differ from PyTorch's.
_compiled = compiled(error_model="numpy")


def planes_of_motions(
    depth: Tensor,
    instance: Tensor | None,
    coefficients: Tensor,
    x: Tensor,
    y: Tensor,
    dt: float | Tensor,
) -> Planes:
    """Returns the flow planes of N motions per map, whose coefficients are A and e `[*B, N, 12]`.

    Depth and the index of each pixel's motion (None if all have motion 0) are `[*B, H, W]`; x
    `[*B, 1, W]` and y `[*B, H, 1]` are `centred_pixels`; dt is a number or `[*B]`.
    """
    *batch, height, width = depth.shape
    maps, motions = math.prod(batch), coefficients.shape[-2]

    # Broadcast all to one batch and flatten it to `maps` maps, without a copy if possible.
    def array(tensor: Tensor, *sizes: int) -> Any:
        rows = tensor.detach().expand((*batch, *sizes)).reshape((maps, *sizes))
        return rows.contiguous().numpy()

    if instance is None:
        ids = torch.empty(0, height, width, dtype=torch.uint8).numpy()
    else:
        ids = array(instance if instance.dtype is torch.uint8 else instance.long(), height, width)
    u, v = torch.empty(2, maps, height, width).unbind()
    valid = torch.empty(maps, height, width, dtype=torch.bool)
    lowest, highest = _fill(
        array(depth, height, width),
        ids,
        array(coefficients, motions, 12),
        array(x.squeeze(-2), width),
        array(y.squeeze(-1), height),
        array(torch.as_tensor(dt, dtype=torch.float32)),
        u.numpy(),
        v.numpy(),
        valid.numpy(),
    )
    check_rows(lowest, highest, motions)
    return u.view(depth.shape), v.view(depth.shape), valid.view(depth.shape)


def object_flow(raw: Tensor, u: Tensor, v: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Returns raw − ego `[*B, 2, H, W]`, 0 where it is unknown, and where it is known `[*B, H, W]`.

    Raw flow is `[*B, 2, H, W]`, float32; ego flow's u, v and bool valid are `[*B, H, W]`.
    """
    *batch, height, width = valid.shape
    maps = math.prod(batch)
    obj = torch.empty(maps, 2, height, width)
    known = torch.empty(maps, height, width, dtype=torch.bool)
    _subtract(
        raw.detach().reshape(maps, 2, height, width).contiguous().numpy(),
        *(plane.reshape(known.shape).numpy() for plane in (u, v, valid)),
        obj.numpy(),
        known.numpy(),
    )
    return obj.view(*batch, 2, height, width), known.view(valid.shape)


@_compiled
def _flow(z, x, y, far, near, dt):
    """Returns u, v and valid of a pixel; q is `far` at infinity."""
    inverse_depth = _ONE / z
    qx = far[0] + near[0] * inverse_depth
    qy = far[1] + near[1] * inverse_depth
    qz = far[2] + near[2] * inverse_depth
    z_ratio = _ONE + qz
    valid = (z >= _LEAST_DEPTH) & (z_ratio > _LEAST_RATIO)
    per_z = _ONE / z_ratio / dt
    u, v = (x * qz - qx) * per_z, (y * qz - qy) * per_z
    return u if valid else _ZERO, v if valid else _ZERO, valid


@_compiled
def _fill(depth, ids, coefficients, xs, ys, dts, u, v, valid):
    """Fills u, v and valid `[N, H, W]`; returns the lowest and the highest id.

    `depth` is `[N, H, W]`, `ids` the same or `[0, H, W]` without ids, `coefficients` `[N, M, 12]`,
    `xs` `[N, W]`, `ys` `[N, H]` and `dts` `[N]`.
    """
    lowest, highest = np.int64(0), np.int64(0)
    maps, height, width = depth.shape
    motions = coefficients.shape[1]
    # First compute every pixel with motion 0 of its frame, that of the static world ...
    for n in range(maps):
        c = coefficients[n, 0]
        near = (c[9], c[10], c[11])
        for i in range(height):
            y = ys[n, i]
            row = (c[3] * y + c[6], c[4] * y + c[7], c[5] * y + c[8])
            for j in range(width):
                x = xs[n, j]
                far = (c[0] * x + row[0], c[1] * x + row[1], c[2] * x + row[2])
                u[n, i, j], v[n, i, j], valid[n, i, j] = _flow(
                    depth[n, i, j], x, y, far, near, dts[n]
                )
    # ... then compute those of moving bodies, which are few, again. In a single loop, the branch on
    # the id would keep the compiler from computing many pixels at once.
    for n in range(len(ids)):
        for i in range(height):
            y = ys[n, i]
            for j in range(width):
                number = np.int64(ids[n, i, j])
                if number == 0:
                    continue
                lowest, highest = min(lowest, number), max(highest, number)
                if number < 0 or number >= motions:
                    continue  # the caller refuses such ids
                x, c = xs[n, j], coefficients[n, number]
                far = (
                    c[0] * x + (c[3] * y + c[6]),
                    c[1] * x + (c[4] * y + c[7]),
                    c[2] * x + (c[5] * y + c[8]),
                )
                u[n, i, j], v[n, i, j], valid[n, i, j] = _flow(
                    depth[n, i, j], x, y, far, (c[9], c[10], c[11]), dts[n]
                )
    return lowest, highest


@_compiled
def _subtract(raw, u, v, valid, obj, known):
    """Fills obj `[N, 2, H, W]` and known `[N, H, W]`."""
    for n in range(len(raw)):
        for i in range(raw.shape[2]):
            for j in range(raw.shape[3]):
                raw_u, raw_v = raw[n, 0, i, j], raw[n, 1, i, j]
                is_known = valid[n, i, j] & (abs(raw_u) + abs(raw_v) < _LARGEST_RAW)
                known[n, i, j] = is_known
                obj[n, 0, i, j] = raw_u - u[n, i, j] if is_known else _ZERO
                obj[n, 1, i, j] = raw_v - v[n, i, j] if is_known else _ZERO
