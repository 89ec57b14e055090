"""Metric depth scaled to [0, 1]."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from flowrep.transforms.base import DEPTH, Keys, MapTransform


class Depth(MapTransform):
    """Depth along the optical axis divided by `range_m`, clipped to [0, 1].

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "depth")`, m | `"depth"` | float32 `[*B, 1, H, W]` | 0 … 1 | `range_m` |

    Sky (`inf`) and everything beyond `range_m` becomes 1, a hole (`nan`) becomes `missing`.

    Args:
        range_m: depth in metres that becomes 1.
        missing: value for `nan`, in [0, 1].
        in_keys: key of metric depth.
        out_keys: key of the representation.

    Raises:
        ValueError: for a range that is not positive and finite, or `missing` outside [0, 1].

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> depth = torch.tensor([[[25.0, 400.0, torch.inf, torch.nan]]])
        >>> Depth(range_m=100.0)(TensorDict({"sensor": {"depth": depth}}))["depth"]
        tensor([[[0.2500, 1.0000, 1.0000, 0.0000]]])
    """

    def __init__(
        self,
        *,
        range_m: float = 100.0,
        missing: float = 0.0,
        in_keys: Keys = ("sensor", "depth"),
        out_keys: Keys = "depth",
    ) -> None:
        super().__init__([DEPTH], in_keys, out_keys)
        if not 0 < range_m < math.inf:
            raise ValueError(f"range_m must be a positive number of metres, got {range_m}")
        if not 0 <= missing <= 1:
            raise ValueError(f"missing must be in [0, 1], the value for nan, got {missing}")
        self.range_m = float(range_m)
        self.missing = float(missing)

    def compute(self, depth: Tensor) -> tuple[Tensor]:
        """Returns depth / range_m in [0, 1]."""
        near = (depth / self.range_m).clamp(0.0, 1.0)  # inf becomes 1, nan stays
        return (torch.where(near.isnan(), self.missing, near).float(),)

    def output_specs(self, depth: TensorSpec) -> tuple[TensorSpec]:
        """Returns a spec bounded to [0, 1]."""
        spec = Bounded(0.0, 1.0, shape=depth.shape, device=depth.device, dtype=torch.float32)
        return (spec,)
