"""Packs observation maps for storage and decodes them for a network, given their specs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, TensorSpec

PRECISIONS = ("auto", "bf16", "fp32")


def compute_dtype(precision: str, device: torch.device) -> torch.dtype:
    """Returns the dtype of activations for `precision` on `device`.

    Args:
        precision: `"bf16"`, `"fp32"`, or `"auto"`: bfloat16 where the device multiplies it faster
            than float32, float32 elsewhere.
        device: where the networks run.

    Raises:
        ValueError: on any other `precision`.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision={precision!r}: expected one of {', '.join(PRECISIONS)}")
    if precision == "auto":
        return torch.bfloat16 if has_fast_bf16(device) else torch.float32
    return torch.bfloat16 if precision == "bf16" else torch.float32


def has_fast_bf16(device: torch.device) -> bool:
    """Returns whether `device` has instructions for bfloat16 products (AVX-512 BF16, AMX, CUDA)."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "cpu":
        instructions = torch.cpu.get_capabilities()
        return bool(instructions.get("avx512_bf16") or instructions.get("amx_bf16"))
    return False


BLOCK = 4  # the stride of the first convolution
KERNEL = 2 * BLOCK
MIN_SIZE = 36  # convolutions of 8/4, 4/2 and 3/1 reduce 36 pixels to one
_FLOAT16_MAX = torch.finfo(torch.float16).max


@dataclass(frozen=True)
class MapCodec:
    """One map: its key in the TensorDict, its size, the meaning of its numbers and their encoding.

    The network computes in `dtype`, bfloat16 or float32.
    """

    key: NestedKey
    channels: int
    height: int
    width: int
    num_classes: int | None
    is_byte: bool
    dtype: torch.dtype

    @property
    def network_channels(self) -> int:
        """Channels of the map that the network sees, before packing."""
        return self.channels * (self.num_classes or 1)

    @property
    def grid(self) -> tuple[int, int]:
        """Height and width in blocks, without rows and columns that no kernel reaches.

        The second convolution has kernel 4 and stride 2, so it skips one of an odd number of rows.
        """
        height, width = ((size - KERNEL) // BLOCK + 1 for size in (self.height, self.width))
        return height // 2 * 2 + 1, width // 2 * 2 + 1

    @property
    def stored_dtype(self) -> torch.dtype:
        """uint8 for ids and intensities, else the two-byte float that suits the network."""
        if self.num_classes or self.is_byte:
            return torch.uint8
        return torch.bfloat16 if self.dtype is torch.bfloat16 else torch.float16

    def batch_shape(self, x: Tensor) -> tuple[int, ...]:
        """Returns the leading dims of a raw map `[*B, C, H, W]`.

        Raises:
            ValueError: if the last three dims are not those of the spec.
        """
        expected = (self.channels, self.height, self.width)
        if tuple(x.shape[-3:]) != expected:
            raise ValueError(
                f"{self.key!r}: the agent was built for maps {expected}, got {tuple(x.shape[-3:])}"
            )
        return tuple(x.shape[:-3])

    def pack(self, x: Tensor) -> Tensor:
        """Returns `x` `[*B, C, H, W]` as blocks `[*B, h, w, C * 16]` of the same dtype."""
        rows, columns = self.grid
        x = x[..., : rows * BLOCK, : columns * BLOCK]
        x = x.unflatten(-1, (columns, BLOCK)).unflatten(-3, (rows, BLOCK))  # [*B, C, h, 4, w, 4]
        x = x.movedim((-4, -2), (-5, -4))  # [*B, h, w, C, 4, 4]
        return x.flatten(-3)

    def compact(self, x: Tensor) -> Tensor:
        """Returns `x` in `stored_dtype`; numbers beyond float16's range saturate."""
        if self.stored_dtype is torch.float16:
            x = x.clamp(-_FLOAT16_MAX, _FLOAT16_MAX)
        return x.to(self.stored_dtype)

    def store(self, x: Tensor) -> Tensor:
        """Returns a raw map `[*B, C, H, W]` in its stored form, compact and packed.

        Raises:
            ValueError: as `batch_shape`.
        """
        self.batch_shape(x)
        return self.pack(self.compact(x))

    def decode(self, packed: Tensor) -> Tensor:
        """Returns `[N, C * 16, h, w]`, channels last in memory, for the encoder.

        Class ids stay uint8, and `convolve` takes them for their one-hot maps; other maps have the
        network's dtype.
        """
        if not self.num_classes:
            packed = packed.to(self.dtype)
            if self.is_byte:
                packed = packed.div_(255)
        return packed.permute(0, 3, 1, 2)

    def pack_weight(self, weight: Tensor) -> Tensor:
        """Returns a `[out, C * n, 8, 8]` kernel as `[out, C * 16 * n, 2, 2]` over packed maps."""
        classes = self.num_classes or 1
        weight = weight.unflatten(-1, (2, BLOCK)).unflatten(-3, (2, BLOCK))
        weight = weight.unflatten(1, (self.channels, classes))  # [out, C, n, 2, 4, 2, 4]
        return weight.permute(0, 1, 4, 6, 2, 3, 5).flatten(1, 4)


def map_codecs(
    observation_spec: Composite, keys: Sequence[NestedKey], dtype: torch.dtype
) -> tuple[MapCodec, ...]:
    """Returns one codec per key, in order, from the specs, whose last three dims are C, H, W.

    Raises:
        ValueError: if `keys` is empty, or a map has the wrong rank, type or size.
        KeyError: if the spec lacks a key.
    """
    if not keys:
        raise ValueError("the agent needs at least one observation key, got none")
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


def decode_maps(codecs: Sequence[MapCodec], packed: TensorDictBase) -> tuple[Tensor, ...]:
    """Returns the decoded maps of a batch `[N]` of packed maps."""
    return tuple(codec.decode(packed[codec.key]) for codec in codecs)


def store_maps(codecs: Sequence[MapCodec], observation: TensorDictBase) -> TensorDictBase:
    """Returns only the observation's maps, in their stored form."""
    stored = observation.empty()
    for codec in codecs:
        stored[codec.key] = codec.store(observation[codec.key])
    return stored
