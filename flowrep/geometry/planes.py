"""Flow planes of one motion for the whole image, or of one for each body in it.

Both do the same operations in the same order, so a static body has exactly the camera's flow, bit
for bit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from flowrep.geometry import single_pass
from flowrep.geometry.camera import centred_pixels
from flowrep.geometry.closed_form import Planes, flow_planes, known_camera, motion_coefficients
from flowrep.geometry.instances import check_rows


def camera_planes(
    depth: Tensor,
    K: Tensor,
    prev_from_curr: Tensor,
    dt: float | Tensor,
    dtypes: tuple[torch.dtype, torch.dtype],
) -> Planes:
    """Returns the flow planes of one motion for the whole image.

    `dtypes` are those of the result and of the computation.
    """
    dtype, compute = dtypes
    K, dt, known = known_camera(K.to(compute), dt)
    coefficients = motion_coefficients(K, prev_from_curr.to(compute), known)
    x, y = centred_pixels(depth.shape[-2], depth.shape[-1], K)
    if single_pass.suits(depth, coefficients, x, dt):
        motions = coefficients.unsqueeze(-2)
        return single_pass.planes_of_motions(depth.squeeze(-3), None, motions, x, y, dt)
    by_motion = coefficients[..., None, None, :]  # [*B, 1, 1, 12]
    axx, axy, ax, ayx, ayy, ay, azx, azy, az, *e = by_motion.unbind(-1)
    # A x~ is the sum of a term per column and one per row, tabulated to save work per pixel.
    x, *columns = _table(x, axx * x, ayx * x, azx * x)
    y, *rows = _table(y, axy * y + ax, ayy * y + ay, azy * y + az)
    q_far = [column + row for column, row in zip(columns, rows)]
    if isinstance(dt, Tensor):
        dt = dt[..., None, None]
    return flow_planes(depth.squeeze(-3), x, y, q_far, e, dt, dtype)


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
    *batch, _, height, width = depth.shape
    K, dt, known = known_camera(K.to(compute), dt)
    motions = prev_from_curr_by_instance.to(compute)
    by_instance = motion_coefficients(K.unsqueeze(-3), motions, known.unsqueeze(-1))  # [*B, N, 12]
    x, y = centred_pixels(height, width, K)
    if single_pass.suits(depth, by_instance, x, dt):
        maps = depth.squeeze(-3), instance.squeeze(-3)
        return single_pass.planes_of_motions(*maps, by_instance, x, y, dt)
    row_of_pixel = instance.long().flatten(-3)  # [*B, H * W]
    try:
        axx, axy, ax, ayx, ayy, ay, azx, azy, az, *e = (
            rows.expand(*batch, -1).gather(-1, row_of_pixel).unflatten(-1, (height, width))
            for rows in by_instance.unbind(-1)
        )
    except RuntimeError:
        check_rows(int(instance.min()), int(instance.max()), by_instance.shape[-2])
        raise
    q_far = [
        axx * x + (axy * y + ax),
        ayx * x + (ayy * y + ay),
        azx * x + (azy * y + az),
    ]
    if isinstance(dt, Tensor):
        dt = dt[..., None, None]
    return flow_planes(depth.squeeze(-3), x, y, q_far, e, dt, dtype)


def _table(*entries: Tensor) -> tuple[Tensor, ...]:
    """Returns the entries as slices of one tensor, which inductor stores and doesn't recompute."""
    return torch.stack(torch.broadcast_tensors(*entries)).unbind()
