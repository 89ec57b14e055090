"""Flow planes of several moving bodies in one image.

Nearly all pixels show the static world. In large batches on a CPU its flow is computed
for the whole image, and bodies are a list of pixels; otherwise each pixel looks up its motion. Both
use the operations of `camera_planes` in the same order, so their results are bitwise equal, and a
static body has exactly the camera's flow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from flowrep.geometry.camera import centred_pixels
from flowrep.geometry.closed_form import (
    Planes,
    camera_planes,
    flow_planes,
    known_camera,
    motion_coefficients,
)

# Pixels up to which a lookup for each costs less than the steps that make a list.
SMALL = 1 << 16


def body_planes(
    depth: Tensor,
    instance: Tensor,
    K: Tensor,
    prev_from_curr_by_instance: Tensor,
    dt: float | Tensor,
    dtypes: tuple[torch.dtype, torch.dtype],
) -> Planes:
    """Returns the flow planes of one motion per instance; `depth` and `instance` share a batch.

    Raises:
        RuntimeError: an id without a motion.
    """
    dtype, compute = dtypes
    motions = prev_from_curr_by_instance.to(compute)
    # When compiled, and on a GPU, no shape may depend on the data.
    if torch.compiler.is_compiling() or not depth.is_cpu or depth.numel() <= SMALL:
        return _dense_body_planes(depth, instance, K.to(compute), motions, dt, dtype)
    static = camera_planes(depth, K, motions[..., 0, :, :], dt, dtypes)
    ids = instance.flatten()
    pixels = ids.nonzero().squeeze(-1)
    if len(pixels) == 0:
        return static
    moving = _sparse_body_planes(depth, ids, pixels, K.to(compute), motions, dt, dtype)
    u, v, valid = (
        plane.flatten().index_put((pixels,), own).view(plane.shape)
        for plane, own in zip(static, moving)
    )
    return u, v, valid


def _sparse_body_planes(
    depth: Tensor,
    ids: Tensor,
    pixels: Tensor,
    K: Tensor,
    motions: Tensor,
    dt: float | Tensor,
    dtype: torch.dtype,
) -> Planes:
    """Returns u, v and valid `[P]` of P pixels, given by their index in the flat depth maps."""
    *batch, _, height, width = depth.shape
    count = motions.shape[-3]
    ids = ids[pixels].long()
    if int(ids.min()) < 0 or int(ids.max()) >= count:
        raise RuntimeError(
            f"instance holds ids {int(ids.min())} to {int(ids.max())}, an index out of "
            f"prev_from_curr_by_instance's {count} rows"
        )
    image = pixels.div(height * width, rounding_mode="floor")
    row = pixels.div(width, rounding_mode="floor") % height
    K, dt, known = known_camera(K, dt)
    pair_of_pixel = image * count + ids
    is_seen = pair_of_pixel.new_zeros(math.prod(batch) * count, dtype=torch.bool)
    is_seen[pair_of_pixel] = True  # most bodies are out of view
    pairs = is_seen.nonzero().squeeze(-1)
    image_of_pair = pairs.div(count, rounding_mode="floor")
    coefficients = motion_coefficients(
        _flat(K, batch, 2)[image_of_pair],
        _flat(motions, batch, 3).flatten(0, 1)[pairs],
        _flat(known, batch, 0)[image_of_pair],
    )  # [pairs, 12]
    place = is_seen.cumsum(0) - 1
    by_pixel = coefficients.t().contiguous().index_select(1, place[pair_of_pixel])
    x, y = centred_pixels(height, width, K)
    x = _flat(x, batch, 2)[image, 0, pixels % width]
    y = _flat(y, batch, 2)[image, row, 0]
    if isinstance(dt, Tensor):
        dt = _flat(dt, batch, 0)[image]
    return _body_pixels(depth.flatten()[pixels], x, y, by_pixel.unbind(0), dt, dtype)


def _flat(tensor: Tensor, batch: Sequence[int], trailing: int) -> Tensor:
    """Returns a tensor expanded to a batch, with the batch as its only leading dim."""
    sizes = tensor.shape[tensor.ndim - trailing :]
    return tensor.expand((*batch, *sizes)).reshape(-1, *sizes)


def _dense_body_planes(
    depth: Tensor,
    instance: Tensor,
    K: Tensor,
    motions: Tensor,
    dt: float | Tensor,
    dtype: torch.dtype,
) -> Planes:
    """Returns u, v and valid of whole images, with a motion looked up for every pixel."""
    *batch, _, height, width = depth.shape
    K, dt, known = known_camera(K, dt)
    row_of_pixel = instance.long().flatten(-3)  # [*B, H * W]
    by_instance = motion_coefficients(K.unsqueeze(-3), motions, known.unsqueeze(-1))  # [*B, N, 12]
    coefficients = [
        rows.expand(*batch, -1).gather(-1, row_of_pixel).unflatten(-1, (height, width))
        for rows in by_instance.unbind(-1)
    ]
    x, y = centred_pixels(height, width, K)
    if isinstance(dt, Tensor):
        dt = dt[..., None, None]
    return _body_pixels(depth.squeeze(-3), x, y, coefficients, dt, dtype)


def _body_pixels(
    depth: Tensor,
    x: Tensor,
    y: Tensor,
    coefficients: Sequence[Tensor],
    dt: float | Tensor,
    dtype: torch.dtype,
) -> Planes:
    """Returns u, v and valid of pixels with 12 coefficients each."""
    axx, axy, ax, ayx, ayy, ay, azx, azy, az, *e = coefficients
    # The same operations in the same order as camera_planes, for bitwise equal results.
    q_far = [
        axx * x + (axy * y + ax),
        ayx * x + (ayy * y + ay),
        azx * x + (azy * y + az),
    ]
    return flow_planes(depth, x, y, q_far, e, dt, dtype)
