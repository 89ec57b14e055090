"""Nature encoders over packed maps, one per map, with concatenated embeddings."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from flowrep.agent.layers import SLOPE, convolve, linear
from flowrep.agent.observation import BLOCK, KERNEL, MapCodec

EMBEDDING_SIZE = 512
STRIDES = (1, 2, 1)  # of the convolutions, in packed pixels


class NatureEncoder(nn.Module):
    """Returns 512 features of a map: 32 × 8/4, 64 × 4/2, 64 × 3/1, linear; LeakyReLU after each.

    Weights are those of ordinary convolutions in float32; they are cast to the codec's dtype. The
    last map is flattened rows first, channels last.
    """

    def __init__(self, codec: MapCodec) -> None:
        super().__init__()
        self.codec = codec
        self.conv1 = nn.Conv2d(codec.network_channels, 32, KERNEL, stride=BLOCK)
        self.conv2 = nn.Conv2d(32, 64, 4, stride=2)
        self.conv3 = nn.Conv2d(64, 64, 3)
        rows, columns = ((((size - 1) - 4) // 2 + 1) - 2 for size in codec.grid)
        self.linear = nn.Linear(64 * rows * columns, EMBEDDING_SIZE)

    def convolutions(self) -> list[Tensor]:
        """Returns weights and biases of the convolutions, the first kernel packed like the maps."""
        kernel = self.codec.pack_weight(self.conv1.weight)
        weights = (kernel, self.conv2.weight, self.conv3.weight)
        biases = (self.conv1.bias, self.conv2.bias, self.conv3.bias)
        both = chain.from_iterable(zip(weights, biases))
        return [tensor for tensor in both if tensor is not None]

    def embed(self, features: Tensor, rows: int | None = None) -> Tensor:
        """Returns the embeddings `[N, 512]` of convolved features; `rows` as in `linear`."""
        return F.leaky_relu_(linear(features, self.linear.weight, self.linear.bias, rows), SLOPE)

    def forward(self, image: Tensor) -> Tensor:
        """Returns the embeddings `[N, 512]` of a decoded map `[N, 16 * C, h, w]`."""
        (features,) = convolve([image], self.convolutions(), STRIDES, self.codec.dtype)
        return self.embed(features)


class Encoder(nn.Module):
    """Returns the concatenated embeddings of several maps, each through its own `NatureEncoder`.

    Args:
        codecs: the maps.
        layer_norm: normalise each embedding to mean 0 and variance 1 (without learnt weights), so
            that all maps have the same scale and the head's input keeps it.
    """

    def __init__(self, codecs: Sequence[MapCodec], *, layer_norm: bool = False) -> None:
        super().__init__()
        self.layer_norm = layer_norm
        self.encoders = nn.ModuleList(NatureEncoder(codec) for codec in codecs)

    @property
    def embedding_size(self) -> int:
        """Width of the concatenation."""
        return EMBEDDING_SIZE * len(self.encoders)

    def forward(self, images: Sequence[Tensor], rows: int | None = None) -> Tensor:
        """Returns the embeddings `[N, 512 * maps]` of decoded maps, in the maps' order.

        Args:
            images: the decoded maps.
            rows: as in `linear`.
        """
        encoders: list[NatureEncoder] = list(self.encoders)  # type: ignore[arg-type]
        weights = [w for encoder in encoders for w in encoder.convolutions()]
        features = convolve(images, weights, STRIDES, encoders[0].codec.dtype)
        embeddings = [encoder.embed(x, rows) for encoder, x in zip(encoders, features)]
        if self.layer_norm:
            embeddings = [F.layer_norm(x, x.shape[-1:]) for x in embeddings]
        return torch.cat(embeddings, dim=-1)
