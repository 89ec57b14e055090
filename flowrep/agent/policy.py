"""Policies, which map raw observation maps to one action."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torch.compiler import is_exporting
from torchrl.data import Composite, TensorSpec

from flowrep.agent.action import DiscreteActions
from flowrep.agent.encoder import Encoder
from flowrep.agent.heads import Head
from flowrep.agent.observation import MapCodec, map_codecs
from flowrep.agent.precision import compute_dtype

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
