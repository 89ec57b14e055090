"""Nature encoders over packed maps: one a map, embeddings concatenated."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from flowrep.agent.observation import BLOCK, KERNEL, MapCodec

EMBEDDING_SIZE = 512


class NatureEncoder(nn.Module):
    """Returns 512 features of a map: 32 × 8/4, 64 × 4/2, 64 × 3/1, linear; LeakyReLU after each.

    Weights are those of ordinary convolutions in float32; they are cast to the dtype of the input,
    so that a bfloat16 map is encoded in bfloat16. The last map is flattened rows first, channels
    last.
    """

    def __init__(self, codec: MapCodec) -> None:
        super().__init__()
        self.codec = codec
        self.conv1 = nn.Conv2d(codec.network_channels, 32, KERNEL, stride=BLOCK)
        self.conv2 = nn.Conv2d(32, 64, 4, stride=2)
        self.conv3 = nn.Conv2d(64, 64, 3)
        rows, columns = ((((size - 1) - 4) // 2 + 1) - 2 for size in codec.grid)
        self.linear = nn.Linear(64 * rows * columns, EMBEDDING_SIZE)

    def forward(self, image: Tensor) -> Tensor:
        """Returns `[N, 512]` of a decoded map `[N, 16 * channels, h, w]`."""
        kernel = self.codec.pack_weight(self.conv1.weight)
        x = _convolve(image, kernel, self.conv1.bias, (1, 1))
        x = _convolve(x, self.conv2.weight, self.conv2.bias, self.conv2.stride)
        x = _convolve(x, self.conv3.weight, self.conv3.bias, self.conv3.stride)
        x = x.permute(0, 2, 3, 1).flatten(1)  # [N, rows * columns * 64]
        return F.leaky_relu_(linear(x, self.linear))


class Encoder(nn.Module):
    """Returns the concatenated embeddings of several maps, each through its own `NatureEncoder`.

    Args:
        codecs: the maps.
        layer_norm: bring each embedding to mean 0 and variance 1 (without weights of its own), so
            that no map is louder than another and the head's input keeps its scale.
    """

    def __init__(self, codecs: Sequence[MapCodec], *, layer_norm: bool = False) -> None:
        super().__init__()
        self.layer_norm = layer_norm
        self.encoders = nn.ModuleList(NatureEncoder(codec) for codec in codecs)

    @property
    def embedding_size(self) -> int:
        """Width of the concatenation."""
        return EMBEDDING_SIZE * len(self.encoders)

    def forward(self, images: Sequence[Tensor]) -> Tensor:
        """Returns `[N, 512 * maps]` of decoded maps, in the maps' order."""
        embeddings = [encode(x) for encode, x in zip(self.encoders, images)]
        if self.layer_norm:
            embeddings = [F.layer_norm(x, x.shape[-1:]) for x in embeddings]
        return torch.cat(embeddings, dim=-1)


def linear(x: Tensor, layer: nn.Linear) -> Tensor:
    """Returns `layer(x)` computed in the dtype of `x`."""
    return F.linear(x, layer.weight.to(x.dtype), layer.bias.to(x.dtype))


def _convolve(x: Tensor, weight: Tensor, bias: Tensor | None, stride: tuple[int, ...]) -> Tensor:
    # channels-last weights keep the whole chain in that layout, without reorders in between
    weight = weight.to(x.dtype, memory_format=torch.channels_last)
    bias = None if bias is None else bias.to(x.dtype)
    return F.leaky_relu_(F.conv2d(x, weight, bias, stride))
