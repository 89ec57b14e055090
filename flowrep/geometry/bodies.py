"""Flow planes of several moving bodies in one image: each pixel follows its own body's motion.

The operations are those of `camera_planes` in the same order, so a static body has exactly the
camera's flow, bit for bit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from flowrep.geometry.camera import centred_pixels
from flowrep.geometry.closed_form import (
    Planes,
    flow_planes,
    known_camera,
    motion_coefficients,
    suits_kernel,
)


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
    if suits_kernel(dtype, depth, by_instance, x, dt):
        from flowrep.geometry import kernel  # needs numba

        maps = depth.squeeze(-3), instance.squeeze(-3)
        return kernel.planes_of_motions(*maps, by_instance, x, y, dt)
    row_of_pixel = instance.long().flatten(-3)  # [*B, H * W]
    axx, axy, ax, ayx, ayy, ay, azx, azy, az, *e = (
        rows.expand(*batch, -1).gather(-1, row_of_pixel).unflatten(-1, (height, width))
        for rows in by_instance.unbind(-1)
    )
    q_far = [
        axx * x + (axy * y + ax),
        ayx * x + (ayy * y + ay),
        azx * x + (azy * y + az),
    ]
    if isinstance(dt, Tensor):
        dt = dt[..., None, None]
    return flow_planes(depth.squeeze(-3), x, y, q_far, e, dt, dtype)
