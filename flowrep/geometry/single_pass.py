"""Flow planes of large maps on a CPU in a single pass over the pixels.

PyTorch needs some twenty passes for `closed_form.flow_planes`, each through memory. Here numba's
machine code does the same operations in the same order, each rounded to float32, so that the
results are bitwise equal. Only maps that `suits` accepts may be passed.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from flowrep.geometry.closed_form import Planes
from flowrep.geometry.instances import check_rows
from flowrep.jit import numba_is_installed

SMALL = 1 << 14  # pixels for which loading numba isn't worth while


def suits(depth: Tensor, *others: float | Tensor) -> bool:
    """Returns whether this module computes flow from these arguments.

    It takes large float32 batches on a CPU, without gradients.
    """
    if torch.compiler.is_compiling():  # first, as a question about sizes would limit the program
        return False
    tensors = [depth, *(other for other in others if isinstance(other, Tensor))]
    return (
        depth.is_cpu
        and depth.numel() > SMALL
        and all(tensor.dtype is torch.float32 and _is_plain(tensor) for tensor in tensors)
        and numba_is_installed()
    )


def _is_plain(tensor: Tensor) -> bool:
    """Returns whether a tensor is numbers in memory: not a subclass, and not being transformed."""
    return (
        type(tensor) in (Tensor, torch.nn.Parameter)
        and not (tensor.requires_grad and torch.is_grad_enabled())
        and not torch._C._functorch.is_functorch_wrapped_tensor(tensor)
        and forward_ad.unpack_dual(tensor).tangent is None
    )


def planes_of_motions(
    depth: Tensor,
    instance: Tensor | None,
    coefficients: Tensor,
    x: Tensor,
    y: Tensor,
    dt: float | Tensor,
) -> Planes:
    """Returns the flow planes of N motions per map.

    Args:
        depth: `[*B, H, W]`, float32, like all other floats.
        instance: `[*B, H, W]`, integers, the motion of each pixel; None if all have motion 0.
        coefficients: A and e of each motion, `[*B, N, 12]`.
        x: pixel centres relative to the principal point, `[*B, 1, W]`.
        y: the same, `[*B, H, 1]`.
        dt: time between the frames, a number or `[*B]`.

    Raises:
        RuntimeError: an id without a motion.
    """
    from flowrep.geometry import kernel  # needs numba

    *batch, height, width = depth.shape
    maps, motions = math.prod(batch), coefficients.shape[-2]

    def array(tensor: Tensor, *sizes: int) -> Any:
        rows = tensor.detach().expand((*batch, *sizes)).reshape((maps, *sizes))
        return rows.contiguous().numpy()

    if instance is None:
        ids = torch.empty(0, height, width, dtype=torch.uint8).numpy()
    else:
        ids = array(instance if instance.dtype is torch.uint8 else instance.long(), height, width)
    u, v = torch.empty(2, maps, height, width).unbind()
    valid = torch.empty(maps, height, width, dtype=torch.bool)
    lowest, highest = kernel.fill(
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
    """Returns raw − ego, 0 where it isn't known, `[*B, 2, H, W]`, and where it is, `[*B, H, W]`.

    Args:
        raw: `[*B, 2, H, W]`, float32.
        u: ego flow to the right, `[*B, H, W]`, float32.
        v: ego flow downwards, likewise.
        valid: where ego flow is known, bool `[*B, H, W]`.
    """
    from flowrep.geometry import kernel  # needs numba

    *batch, height, width = valid.shape
    maps = math.prod(batch)
    obj = torch.empty(maps, 2, height, width)
    known = torch.empty(maps, height, width, dtype=torch.bool)
    kernel.subtract(
        raw.detach().reshape(maps, 2, height, width).contiguous().numpy(),
        *(plane.reshape(known.shape).numpy() for plane in (u, v, valid)),
        obj.numpy(),
        known.numpy(),
    )
    return obj.view(*batch, 2, height, width), known.view(valid.shape)
