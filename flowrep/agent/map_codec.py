"""Stores observation maps compactly and decodes them for a network, given their specs.

| spec | means | stored as | the network sees |
| --- | --- | --- | --- |
| `Categorical(n)` | a class id per pixel, C stacked frames | uint8 | one-hot, `C * n` channels |
| `Bounded(0, 255, uint8)` | intensity | uint8 | `x / 255`, C channels |
| any float | a quantity | two-byte float | itself, C channels |

An id from n to 255 is a pixel without a class; all its channels are 0. One-hot maps are computed
when a batch is decoded, and never stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, TensorSpec

MIN_SIZE = 36  # convolutions of 8/4, 4/2 and 3/1 reduce 36 pixels to one
_FLOAT16_MAX = torch.finfo(torch.float16).max


@dataclass(frozen=True)
class MapCodec:
    """Stores and decodes one map, for a network in `dtype`, bfloat16 or float32."""

    key: NestedKey
    channels: int
    height: int
    width: int
    num_classes: int | None
    is_byte: bool
    dtype: torch.dtype

    @property
    def network_channels(self) -> int:
        """Channels of the map that the network sees."""
        return self.channels * (self.num_classes or 1)

    @property
    def stored_dtype(self) -> torch.dtype:
        """uint8 for ids and intensities, else the two-byte float that suits the network."""
        if self.num_classes or self.is_byte:
            return torch.uint8
        return torch.bfloat16 if self.dtype is torch.bfloat16 else torch.float16

    def store(self, x: Tensor) -> Tensor:
        """Returns a raw map `[*B, C, H, W]` in `stored_dtype`, saturated to its range."""
        expected = (self.channels, self.height, self.width)
        if tuple(x.shape[-3:]) != expected:
            raise ValueError(
                f"{self.key!r}: the agent was built for maps {expected}, got {tuple(x.shape[-3:])}"
            )
        if self.stored_dtype is torch.float16:
            x = x.clamp(-_FLOAT16_MAX, _FLOAT16_MAX)
        return x.to(self.stored_dtype)

    def decode(self, stored: Tensor) -> Tensor:
        """Returns a stored map `[N, C, H, W]` as the network sees it, channels last in memory.

        Channel c * num_classes + id of a one-hot map is 1 where frame c shows that id.
        """
        if self.num_classes:
            # Looking up rows of the identity is several times faster than comparing ids.
            identity = torch.eye(256, self.num_classes, device=stored.device, dtype=self.dtype)
            ids = stored.permute(0, 2, 3, 1).int()
            return F.embedding(ids, identity).flatten(-2).permute(0, 3, 1, 2)
        x = stored.to(self.dtype, memory_format=torch.channels_last)
        return x / 255 if self.is_byte else x


def map_codecs(
    observation_spec: Composite, keys: Sequence[NestedKey], dtype: torch.dtype
) -> tuple[MapCodec, ...]:
    """Returns one codec per key, in order, from the specs, whose last three dims are C, H, W."""
    if isinstance(keys, str) or not keys:
        raise ValueError(f"the agent needs a list of observation keys, got {keys!r}")
    offered = observation_spec.keys(include_nested=True, leaves_only=True)
    for key in keys:
        if key not in offered:
            raise KeyError(f"the agent reads {key!r}; the environment offers {list(offered)}")
    return tuple(_codec(key, observation_spec[key], dtype) for key in keys)


def _codec(key: NestedKey, spec: TensorSpec, dtype: torch.dtype) -> MapCodec:
    if len(spec.shape) < 3:
        raise ValueError(f"{key!r}: expected a map [..., C, H, W], got shape {tuple(spec.shape)}")
    channels, height, width = spec.shape[-3:]
    if min(height, width) < MIN_SIZE:
        raise ValueError(
            f"{key!r} is {height}x{width}: the Nature encoder needs at least "
            f"{MIN_SIZE}x{MIN_SIZE} pixels; raise the camera's height_px and width_px"
        )
    num_classes, is_byte = None, False
    if isinstance(spec, Categorical):
        num_classes = int(spec.space.n)
        if num_classes > 256:
            raise ValueError(f"{key!r} has {num_classes} classes; ids are stored in a byte: <= 256")
    elif spec.dtype is torch.uint8:
        is_byte = True
        low, high = spec.space.low.min().item(), spec.space.high.max().item()
        if (low, high) != (0, 255):
            raise ValueError(
                f"{key!r} is uint8 in [{low}, {high}], which could be ids or intensities: declare "
                "it Categorical(n) or Bounded(0, 255)"
            )
    elif not spec.dtype.is_floating_point:
        raise ValueError(
            f"{key!r} has dtype {spec.dtype}: expected Categorical ids, uint8 in 0..255, or floats"
        )
    return MapCodec(key, channels, height, width, num_classes, is_byte, dtype)


def store_maps(codecs: Sequence[MapCodec], observation: TensorDictBase) -> TensorDictBase:
    """Returns only the observation's maps, in their stored form."""
    stored = observation.empty()
    for codec in codecs:
        stored[codec.key] = codec.store(observation[codec.key])
    return stored


def decode_maps(codecs: Sequence[MapCodec], stored: TensorDictBase) -> tuple[Tensor, ...]:
    """Returns the maps of a batch `[N]` as the network sees them."""
    return tuple(codec.decode(stored[codec.key]) for codec in codecs)
