"""Conversion of a simulator's segmentation ids to the ids that raw flow reads."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torchrl.data import Categorical, TensorSpec

from flowrep import geometry
from flowrep.transforms.base import IDS, Keys, MapTransform, check_own_keys


class InstanceIds(MapTransform):
    """Converts a simulator's segmentation ids to rows of `instance_motion`.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | ids | `("sensor", "instance")` | uint8 `[*B, 1, H, W]` (int32 from 256 bodies) | 0 … N | row |

    Args:
        body_ids: the ids of the bodies, in the order of their poses: the first becomes 1. Every
            other id, also a negative one, becomes 0, the static world.
        in_keys: key of the env's ids.
        out_keys: key of the rows; must differ, so that nothing is adapted twice.

    Raises:
        ValueError: for a repeated id.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> rows = InstanceIds([17, 3], in_keys="segmentation")
        >>> td = rows(TensorDict(segmentation=torch.tensor([[[0, 3, 17, -1]]])))
        >>> td["sensor", "instance"]
        tensor([[[0, 2, 1, 0]]], dtype=torch.uint8)
    """

    body_ids: Tensor

    def __init__(
        self,
        body_ids: Sequence[int],
        *,
        in_keys: Keys = "segmentation",
        out_keys: Keys = ("sensor", "instance"),
    ) -> None:
        super().__init__([IDS], in_keys, out_keys)
        check_own_keys(self)
        if len(set(body_ids)) != len(body_ids):
            raise ValueError(f"body_ids must name each body once, got {list(body_ids)}")
        ids = torch.tensor(list(body_ids), dtype=torch.long)
        self.register_buffer("body_ids", ids, persistent=False)

    def compute(self, ids: Tensor) -> tuple[Tensor]:
        """Returns each pixel's row."""
        return (geometry.instance_rows(ids, self.body_ids),)

    def output_specs(self, ids: TensorSpec) -> tuple[TensorSpec]:
        """Returns a categorical spec of 1 + N rows."""
        rows = 1 + len(self.body_ids)
        dtype = torch.uint8 if rows <= 256 else torch.int32
        return (Categorical(rows, shape=ids.shape, device=ids.device, dtype=dtype),)
