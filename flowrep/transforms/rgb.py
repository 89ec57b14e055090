"""The camera's picture."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from flowrep.transforms.base import RGB, Keys, MapTransform


class Rgb(MapTransform):
    """The camera's colour picture, unchanged.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "rgb")` | `"rgb"` | uint8 `[*B, 3, H, W]` | 0 … 255 | |

    It stays uint8, which takes a quarter of the memory of float32 in a replay buffer. A network can
    read the divisor from the spec's bounds.

    Args:
        in_keys: key of the picture.
        out_keys: key of the representation.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> picture = torch.full((3, 2, 4), 7, dtype=torch.uint8)
        >>> Rgb()(TensorDict({"sensor": {"rgb": picture}}))["rgb"].shape
        torch.Size([3, 2, 4])
    """

    def __init__(
        self,
        *,
        in_keys: Keys = ("sensor", "rgb"),
        out_keys: Keys = "rgb",
    ) -> None:
        super().__init__([RGB], in_keys, out_keys)

    def compute(self, rgb: Tensor) -> tuple[Tensor]:
        """Returns the picture in uint8."""
        return (rgb.to(torch.uint8),)

    def output_specs(self, rgb: TensorSpec) -> tuple[TensorSpec]:
        """Returns a spec bounded to 0 … 255."""
        return (Bounded(0, 255, shape=rgb.shape, device=rgb.device, dtype=torch.uint8),)
