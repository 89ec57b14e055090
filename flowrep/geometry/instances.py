"""Conversion of a simulator's segmentation ids to rows of `instance_motion`."""

from __future__ import annotations

import torch
from torch import Tensor

from flowrep.geometry.checks import check_is_tensor


def instance_rows(ids: Tensor, body_ids: Tensor) -> Tensor:
    """Returns each pixel's row of `instance_motion`, in the shape of `ids`.

    Convention: id `body_ids[i]` becomes 1 + i; any other id, also a negative one, becomes 0, the
    static world.

    Args:
        ids: integers of any shape, as the simulator renders them.
        body_ids: `[N]`, integers, in the order of the bodies' poses.

    Raises:
        ValueError: `body_ids` is not `[N]`.
        TypeError: not integers.

    >>> ids = torch.tensor([[[0, 17, 3, -1, 18]]])
    >>> instance_rows(ids, torch.tensor([17, 3]))
    tensor([[[0, 1, 2, 0, 0]]], dtype=torch.uint8)
    """
    for name, value in {"ids": ids, "body_ids": body_ids}.items():
        check_is_tensor(name, value)
        if value.is_floating_point() or value.is_complex() or value.dtype is torch.bool:
            raise TypeError(f"{name} must hold integer ids, got {value.dtype}")
    if body_ids.ndim != 1:
        raise ValueError(f"body_ids must be [N], got {list(body_ids.shape)}")
    count = len(body_ids)
    dtype = torch.uint8 if count < 256 else torch.int32
    if count == 0:
        return torch.zeros_like(ids, dtype=dtype)
    # Sorted and searched instead of tabulated, as ids may be as large as a packed colour.
    ascending, order = body_ids.long().sort()
    ids = ids.long()
    nearest = torch.searchsorted(ascending, ids.contiguous()).clamp(max=count - 1)
    return torch.where(ascending[nearest] == ids, order[nearest] + 1, 0).to(dtype)


def check_rows(lowest: int, highest: int, rows: int) -> None:
    """Raises RuntimeError if ids from `lowest` to `highest` are no rows of `rows` motions."""
    if lowest < 0 or highest >= rows:
        raise RuntimeError(
            f"instance holds ids {lowest} to {highest}, but prev_from_curr_by_instance has {rows} "
            f"rows, for ids 0 to {rows - 1}; convert a simulator's ids, such as -1 for the "
            "background, with the transform InstanceIds or with flowrep.geometry.instance_rows"
        )
