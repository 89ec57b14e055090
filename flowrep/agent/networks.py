"""Networks and policies: one Nature encoder per map, then a head with one number per action."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import NestedKey
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torch.compiler import is_exporting
from torchrl.data import Categorical, Composite, OneHot, TensorSpec
from torchrl.modules import OneHotCategorical

from flowrep.agent.layers import SLOPE, convolve, linear
from flowrep.agent.observation import BLOCK, KERNEL, MapCodec, compute_dtype, map_codecs


@dataclass(frozen=True)
class DiscreteActions:
    """The number of actions, TorchRL's name for their encoding and the matching distribution."""

    count: int
    space: str
    distribution: type[torch.distributions.Distribution]

    @classmethod
    def from_spec(cls, spec: TensorSpec) -> DiscreteActions:
        """Reads a `Categorical` or `OneHot` spec.

        Raises:
            TypeError: if the spec is of any other type.
        """
        if type(spec) is Categorical:  # its subclasses encode several choices at once
            return cls(int(spec.space.n), "categorical", torch.distributions.Categorical)
        if type(spec) is OneHot:
            return cls(int(spec.space.n), "one-hot", OneHotCategorical)
        raise TypeError(
            f"discrete SAC needs a Categorical or OneHot action spec, got {type(spec).__name__}"
        )


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


class Head(nn.Module):
    """Maps `[N, embedding]` to `[N, n_actions]` float32: linear, Swish, linear.

    The hidden layer computes in the dtype of its input, the output layer in float32.
    """

    def __init__(self, embedding_size: int, hidden_size: int, n_actions: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(embedding_size, hidden_size)
        self.output = nn.Linear(hidden_size, n_actions)

    def forward(self, embedding: Tensor, rows: int | None = None) -> Tensor:
        """Returns one float32 number per action; `rows` as in `linear`."""
        hidden = F.silu(linear(embedding, self.hidden.weight, self.hidden.bias, rows))
        if rows is None:
            return self.output(hidden.float())
        return linear(hidden.float(), self.output.weight, self.output.bias, rows)


def heads_together(embedding: Tensor, weights: Mapping[str, Any]) -> Tensor:
    """Returns the outputs `[heads, N, n_actions]` of several heads on one embedding.

    Args:
        embedding: `[N, embedding]`, the input of all heads.
        weights: those of `Head` by module and name, stacked along a first dim of heads.
    """
    hidden, output = weights["hidden"], weights["output"]
    x = linear(embedding, hidden["weight"].flatten(0, 1), hidden["bias"].flatten())
    x = F.silu(x).float().unflatten(-1, hidden["bias"].shape).movedim(-2, 0)
    return torch.baddbmm(output["bias"].unsqueeze(-2), x, output["weight"].mT)


# Convolutions of fewer maps are rounded differently, and so are products of another number of rows;
# actions would depend on the size of the batch.
SMALLEST_BATCH = 8
ROWS = 32


class MapNetwork(nn.Module):
    """Maps decoded maps to `[N, outputs]` float32: one encoder per map, then a head.

    Args:
        codecs: the maps.
        hidden_size: width of the single hidden layer after the embeddings.
        outputs: numbers per observation.
        layer_norm: normalise each map's embedding, see `Encoder`.
    """

    def __init__(
        self,
        codecs: Sequence[MapCodec],
        hidden_size: int,
        outputs: int,
        *,
        layer_norm: bool = False,
    ) -> None:
        super().__init__()
        self.codecs, self.hidden_size = tuple(codecs), hidden_size
        self.encoder = Encoder(codecs, layer_norm=layer_norm)
        self.head = Head(self.encoder.embedding_size, hidden_size, outputs)

    def forward(self, images: Sequence[Tensor], rows: int | None = None) -> Tensor:
        """Returns `[N, outputs]`.

        Args:
            images: the decoded maps.
            rows: of each product on a CPU, see `flowrep.agent.layers.linear`.
        """
        return self.head(self.encoder(images, rows), rows)

    def another_encoder(self) -> Encoder:
        """Returns an encoder for the same maps with its own weights."""
        return Encoder(self.codecs, layer_norm=self.encoder.layer_norm)

    def another(self, outputs: int) -> MapNetwork:
        """Returns a network for the same maps and sizes with its own weights."""
        layer_norm = self.encoder.layer_norm
        return MapNetwork(self.codecs, self.hidden_size, outputs, layer_norm=layer_norm)


class PackedNetwork(nn.Module):
    """Applies `network` to packed maps `[N, h, w, C * 16]`, one argument per map."""

    def __init__(self, codecs: Sequence[MapCodec], network: MapNetwork) -> None:
        super().__init__()
        self.codecs, self.network = tuple(codecs), network

    def forward(self, *packed: Tensor) -> Tensor:
        """Returns the network's output for the decoded maps."""
        return self.network([codec.decode(x) for codec, x in zip(self.codecs, packed)])


class PolicyNetwork(nn.Module):
    """Maps raw maps `[*B, C, H, W]`, one argument each, to one number per action `[*B, n]`.

    On a CPU the numbers of an observation are the same, bit for bit, in a batch of any size.
    """

    def __init__(self, codecs: Sequence[MapCodec], network: MapNetwork) -> None:
        super().__init__()
        self.codecs, self.network = tuple(codecs), network

    def forward(self, *maps: Tensor) -> Tensor:
        """Returns the network's output; the maps are stored and decoded first, as in training."""
        images = []
        for codec, x in zip(self.codecs, maps):
            batch = codec.batch_shape(x)
            packed = codec.store(x.reshape(-1, *x.shape[-3:]))
            images.append(codec.decode(packed if is_exporting() else _padded(packed)))
        outputs = self.network(images, ROWS)
        if not is_exporting():
            outputs = outputs[: math.prod(batch)]
        return outputs.reshape(*batch, outputs.shape[-1])


def _padded(packed: Tensor) -> Tensor:
    """Returns at least `SMALLEST_BATCH` rows, the last one repeated."""
    missing = SMALLEST_BATCH - len(packed)
    if missing <= 0 or not len(packed):
        return packed
    return torch.cat([packed, packed[-1:].expand(missing, *packed.shape[1:])])


def acting_network(
    observation_spec: Composite,
    action_spec: TensorSpec,
    keys: Sequence[NestedKey],
    *,
    device: torch.device,
    precision: str,
    hidden_size: int,
    layer_norm: bool = False,
) -> PolicyNetwork:
    """Returns the untrained network of a policy: one encoder per map, then a head."""
    codecs = map_codecs(observation_spec, keys, compute_dtype(precision, device))
    actions = DiscreteActions.from_spec(action_spec)
    with device:
        network = MapNetwork(codecs, hidden_size, actions.count, layer_norm=layer_norm)
    return PolicyNetwork(codecs, network)


def stochastic_policy(
    network: nn.Module,
    in_keys: Sequence[NestedKey],
    actions: DiscreteActions,
    *,
    writes_log_prob: bool = False,
) -> ProbabilisticTensorDictSequential:
    """Returns a module that writes `action`, drawn from the softmax of the network's logits.

    With `writes_log_prob` it also writes `action_log_prob`.

    Under TorchRL's `set_exploration_type(ExplorationType.DETERMINISTIC)` it takes the likeliest
    action instead.
    """
    draw = ProbabilisticTensorDictModule(
        in_keys=["logits"],
        out_keys=["action"],
        distribution_class=actions.distribution,
        distribution_kwargs={"validate_args": False},
        default_interaction_type=InteractionType.RANDOM,
        return_log_prob=writes_log_prob,
        log_prob_key="action_log_prob",
    )
    logits = TensorDictModule(network, in_keys=list(in_keys), out_keys=["logits"])
    written = ["action", "action_log_prob"] if writes_log_prob else ["action"]
    return ProbabilisticTensorDictSequential(logits, draw).select_out_keys(*written)
