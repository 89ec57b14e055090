"""Flow on a CPU in a single pass over the pixels; importing this needs numba.

PyTorch needs about twenty passes through memory for `closed_form.flow_planes`: 11.3 ms for a step
of 96 envs at 84 × 84, where these kernels take 3.7 ms. For a single frame, its hundred calls take
six times as long as the pass. The kernels do the same operations in the same order, each rounded to
float32, so that the results are bitwise equal. If you change one, change the other. `flow` decides
which maps are computed here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flowrep.extras import compiled
from flowrep.geometry.checks import check_rows
from flowrep.geometry.closed_form import LARGEST, LEAST_POSITIVE, MIN_DEPTH_RATIO, largest_raw

# numpy's float32 scalars: a Python float would make numba compute in float64.
_LEAST, _LEAST_RATIO = np.float32(LEAST_POSITIVE), np.float32(MIN_DEPTH_RATIO)
_LARGEST, _LARGEST_RAW = np.float32(LARGEST), np.float32(largest_raw(torch.float32))
_ZERO, _HALF, _ONE, _BEHIND = (np.float32(number) for number in (0.0, 0.5, 1.0, -2.0))
_NO_IDS, _NO_MATRIX = np.empty((0, 1, 0, 0), np.uint8), np.empty((0, 3, 3), np.float32)
_NO_FLOW, _NO_MASK = np.empty((0, 2, 0, 0), np.float32), np.empty((0, 1, 0, 0), np.bool_)
_NO_FACTORS, _NO_MOTIONS = (_NO_FLOW, _NO_FLOW, _NO_MASK), np.empty((0, 0, 4, 4), np.float32)
_STILL = np.eye(3, 4, dtype=np.float32)

# "numpy": a division by 0 gives inf, as in PyTorch, without a branch that raises. No fastmath: it
# may fuse or reorder operations, and the last bits would differ from PyTorch's.
_compiled = compiled(error_model="numpy")


def planes(
    batch: torch.Size,
    depth: Tensor,
    K: Tensor,
    prev_K: Tensor | None,
    dt: float | Tensor,
    *,
    motions: Tensor | None = None,
    instance: Tensor | None = None,
    raw: Tensor | None = None,
    raw_known: Tensor | None = None,
    camera: Tensor | None = None,
) -> list[Tensor]:
    """Returns raw flow and its mask; with the camera's motion also ego, obj and their mask.

    Raw flow is given, or is that of one motion per instance, `[*B, N, 4, 4]`; without ids, of the
    first one.
    """
    size = depth.shape[-2:]
    maps = math.prod(batch)

    # Broadcasts to one batch and flattens it, without a copy if possible. Calls of numpy take a
    # quarter of the time of PyTorch's, and there is one frame in the batch of an env that is alone.
    def array(tensor: Tensor, *sizes: int) -> Any:
        if tensor.shape != (*batch, *sizes):
            tensor = tensor.expand(*batch, *sizes)
        if tensor.requires_grad:
            tensor = tensor.detach()
        return np.ascontiguousarray(tensor.numpy()).reshape(maps, *sizes)

    def empty(channels: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(*batch, channels, *size, dtype=dtype)

    rows = 0 if motions is None else motions.shape[-3]
    if instance is not None and instance.dtype is not torch.uint8:
        instance = instance.long()
    if raw is None:
        raw, raw_known = empty(2), empty(1, torch.bool)
    elif raw_known is None:
        raw_known = torch.ones(1, *size, dtype=torch.bool)
    factors = [] if camera is None else [empty(2), empty(2), empty(1, torch.bool)]
    if isinstance(dt, Tensor):
        dts = array(dt.masked_fill(dt.isinf(), math.nan))
    else:
        dts = np.full(maps, dt, np.float32)
    lowest, highest = _fill(
        array(depth, 1, *size),
        _NO_IDS if instance is None else array(instance, 1, *size),
        array(K, 3, 3),
        _NO_MATRIX if prev_K is None else array(prev_K, 3, 3),
        dts,
        _NO_MOTIONS if motions is None else array(motions, rows, 4, 4),
        _NO_MATRIX if camera is None else array(camera, 4, 4),
        array(raw, 2, *size),
        array(raw_known, 1, *size),
        *([x.numpy().reshape(maps, x.shape[-3], *size) for x in factors] or _NO_FACTORS),
    )
    check_rows(lowest, highest, max(rows, 1))
    return [raw, raw_known, *factors]


@_compiled
def _is_known(K):
    known = (K[0, 0] != _ZERO) & (K[1, 1] != _ZERO)
    for entry in K.flat:
        known &= abs(entry) <= _LARGEST  # nan compares False
    return known


@_compiled
def _coefficients(c, motion, K, prev_K, zooms, known):
    """Fills c with A (column by column) and e, see `closed_form.motion_coefficients`."""
    for entry in motion.flat:
        known &= abs(entry) <= _LARGEST
    for i in range(4):
        x, y, z = motion[0, i], motion[1, i], motion[2, i]
        x, y, z = x - _STILL[0, i], y - _STILL[1, i], z - _STILL[2, i]
        x, y = prev_K[0, 0] * x + prev_K[0, 1] * y, prev_K[1, 1] * y
        if zooms:
            x += (prev_K[0, 2] - K[0, 2]) * z
            y += (prev_K[1, 2] - K[1, 2]) * z
            x += prev_K[0, i] - K[0, i] if i < 3 else _ZERO
            y += prev_K[1, i] - K[1, i] if i < 3 else _ZERO
        c[3 * i], c[3 * i + 1], c[3 * i + 2] = x, y, z
    for i in range(3):
        c[i] = c[i] / K[0, 0]
        c[3 + i] = (c[3 + i] - K[0, 1] * c[i]) / K[1, 1]
    for entry in c:
        known &= abs(entry) <= _LARGEST
    if not known:
        c[:] = _ZERO
        c[8] = _BEHIND


@_compiled
def _flow(z, x, y, far, near, dt):
    """Returns u, v and valid of a pixel; q is `far` at infinity."""
    inverse_depth = _ONE / z
    qx = far[0] + near[0] * inverse_depth
    qy = far[1] + near[1] * inverse_depth
    qz = far[2] + near[2] * inverse_depth
    z_ratio = _ONE + qz
    valid = (z >= _LEAST) & (z_ratio > _LEAST_RATIO)
    per_z = _ONE / z_ratio / dt
    u, v = (x * qz - qx) * per_z, (y * qz - qy) * per_z
    return u if valid else _ZERO, v if valid else _ZERO, valid


@_compiled
def _fill_static(depth, xs, y_0, c, dt, flow, known):
    """Fills flow `[2, H, W]` and known `[1, H, W]` of one motion, whose coefficients are c."""
    near = (c[9], c[10], c[11])
    for i in range(depth.shape[1]):
        y = np.float32(i) + _HALF - y_0
        row = (c[3] * y + c[6], c[4] * y + c[7], c[5] * y + c[8])
        for j in range(depth.shape[2]):
            x = xs[j]
            far = (c[0] * x + row[0], c[1] * x + row[1], c[2] * x + row[2])
            flow[0, i, j], flow[1, i, j], known[0, i, j] = _flow(
                depth[0, i, j], x, y, far, near, dt
            )


@_compiled
def _fill_bodies(depth, ids, xs, y_0, c, dt, flow, known):
    """Fills the pixels of moving bodies, ids from 1 on; returns the lowest and highest id."""
    lowest, highest = np.int64(0), np.int64(0)
    for i in range(depth.shape[1]):
        y = np.float32(i) + _HALF - y_0
        for j in range(depth.shape[2]):
            number = np.int64(ids[0, i, j])
            if number == 0:
                continue
            lowest, highest = min(lowest, number), max(highest, number)
            if number < 0 or number >= len(c):
                continue  # the caller refuses such ids
            x, b = xs[j], c[number]
            far = (
                b[0] * x + (b[3] * y + b[6]),
                b[1] * x + (b[4] * y + b[7]),
                b[2] * x + (b[5] * y + b[8]),
            )
            flow[0, i, j], flow[1, i, j], known[0, i, j] = _flow(
                depth[0, i, j], x, y, far, (b[9], b[10], b[11]), dt
            )
    return lowest, highest


@_compiled
def _subtract(raw, raw_known, ego, obj, known):
    """Fills obj `[2, H, W]`, and makes known `[1, H, W]` False where raw flow isn't measured."""
    for i in range(raw.shape[1]):
        for j in range(raw.shape[2]):
            u, v = raw[0, i, j], raw[1, i, j]
            measured = known[0, i, j] & raw_known[0, i, j] & (abs(u) + abs(v) < _LARGEST_RAW)
            known[0, i, j] = measured
            obj[0, i, j] = u - ego[0, i, j] if measured else _ZERO
            obj[1, i, j] = v - ego[1, i, j] if measured else _ZERO


@_compiled
def _fill(depth, ids, Ks, prev_Ks, dts, motions, cameras, raw, raw_known, ego, obj, known):
    """Fills what isn't given, see `planes`; everything has N maps, or none. Returns extreme ids."""
    lowest, highest = np.int64(0), np.int64(0)
    zooms = len(prev_Ks) > 0
    c = np.empty((motions.shape[1], 12), np.float32)
    of_camera = np.empty(12, np.float32)
    xs = np.empty(depth.shape[3], np.float32)
    for n in range(len(depth)):
        K, dt = Ks[n], dts[n]
        prev_K = prev_Ks[n] if zooms else K
        is_known = _is_known(K) & _is_known(prev_K) & (dt >= _LEAST)
        for j in range(len(xs)):
            xs[j] = np.float32(j) + _HALF - K[0, 2]
        if len(motions):
            for number in range(len(c)):
                _coefficients(c[number], motions[n, number], K, prev_K, zooms, is_known)
            # First every pixel as if it stood still, then those of bodies, which are few, again. In
            # a single loop, the branch on the id would keep the compiler from computing many pixels
            # at once.
            _fill_static(depth[n], xs, K[1, 2], c[0], dt, raw[n], raw_known[n])
            if len(ids):
                low, high = _fill_bodies(depth[n], ids[n], xs, K[1, 2], c, dt, raw[n], raw_known[n])
                lowest, highest = min(lowest, low), max(highest, high)
        if len(cameras):
            _coefficients(of_camera, cameras[n], K, prev_K, zooms, is_known)
            _fill_static(depth[n], xs, K[1, 2], of_camera, dt, ego[n], known[n])
            _subtract(raw[n], raw_known[n], ego[n], obj[n], known[n])
    return lowest, highest
