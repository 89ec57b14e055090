"""The loops of `flowrep.geometry.single_pass`, compiled by numba at their first call.

Arrays are float32, but for integer ids and bool masks; maps are the first axis.
"""

import numpy as np
import torch

from flowrep.geometry.closed_form import MIN_DEPTH_RATIO, SMALLEST, largest_raw
from flowrep.jit import compiled

_LEAST_DEPTH, _LEAST_RATIO = np.float32(SMALLEST), np.float32(MIN_DEPTH_RATIO)
_LARGEST_RAW = np.float32(largest_raw(torch.float32))
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)

# "numpy": a division by 0 is inf, as in PyTorch, and leaves no branch in the loop
_compiled = compiled(error_model="numpy")


@_compiled
def fill(depth, ids, coefficients, xs, ys, dts, u, v, valid):
    """Fills u, v and valid; returns the lowest and the highest id."""
    lowest, highest = np.int64(0), np.int64(0)
    maps, height, width = depth.shape
    motions = coefficients.shape[1]
    for n in range(maps):
        c = coefficients[n, 0]
        near = (c[9], c[10], c[11])
        for i in range(height):
            y = ys[n, i]
            row = (c[1] * y + c[2], c[4] * y + c[5], c[7] * y + c[8])
            for j in range(width):
                x = xs[n, j]
                far = (c[0] * x + row[0], c[3] * x + row[1], c[6] * x + row[2])
                u[n, i, j], v[n, i, j], valid[n, i, j] = _flow(
                    depth[n, i, j], x, y, far, near, dts[n]
                )
    # Apart from the loop above, which has no branches and so computes many pixels at once.
    for n in range(len(ids)):
        for i in range(height):
            y = ys[n, i]
            for j in range(width):
                number = np.int64(ids[n, i, j])
                if number == 0:
                    continue
                lowest, highest = min(lowest, number), max(highest, number)
                if number < 0 or number >= motions:
                    continue
                x, c = xs[n, j], coefficients[n, number]
                far = (
                    c[0] * x + (c[1] * y + c[2]),
                    c[3] * x + (c[4] * y + c[5]),
                    c[6] * x + (c[7] * y + c[8]),
                )
                u[n, i, j], v[n, i, j], valid[n, i, j] = _flow(
                    depth[n, i, j], x, y, far, (c[9], c[10], c[11]), dts[n]
                )
    return lowest, highest


@_compiled
def subtract(raw, u, v, valid, obj, known):
    """Fills obj and known."""
    for n in range(len(raw)):
        for i in range(raw.shape[2]):
            for j in range(raw.shape[3]):
                raw_u, raw_v = raw[n, 0, i, j], raw[n, 1, i, j]
                is_known = valid[n, i, j] & (abs(raw_u) + abs(raw_v) < _LARGEST_RAW)
                known[n, i, j] = is_known
                obj[n, 0, i, j] = raw_u - u[n, i, j] if is_known else _ZERO
                obj[n, 1, i, j] = raw_v - v[n, i, j] if is_known else _ZERO


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
