"""Networks and policies: one Nature encoder per map, then a head with one number per action.

Weights are float32. By autocast, encoders and hidden layers compute in the codec's dtype. The last
layer computes in float32, because small differences between its outputs matter. `hidden_size` is an
option of an algorithm; the encoder's widths stand in `NatureEncoder`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
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
from torchrl.data import Categorical, TensorSpec

from flowrep.agent.map_codec import MapCodec

EMBEDDING_SIZE = 512


def action_count(spec: TensorSpec) -> int:
    """Returns the number of actions of a `Categorical` spec; TypeError for another."""
    if type(spec) is not Categorical:  # its subclasses encode several choices at once
        raise TypeError(
            f"expected a Categorical action spec, got {type(spec).__name__}; TorchRL's wrappers "
            "have one with categorical_action_encoding=True"
        )
    return int(spec.space.n)


def _autocast_like(x: Tensor) -> AbstractContextManager[Any]:
    """Returns a context in which stock layers compute in the dtype of `x`."""
    if x.dtype is torch.float32:
        return nullcontext()
    return torch.autocast(x.device.type, x.dtype)


class NatureEncoder(nn.Module):
    """Maps a decoded map `[N, C, H, W]` to 512 features `[N, 512]`.

    The layers are convolutions with (channels, kernel / stride) 32, 8/4; 64, 4/2; 64, 3/1 and a
    linear layer, each followed by LeakyReLU. Maps of 84 × 84 become 20 × 20, 9 × 9 and 7 × 7; maps
    of 48 × 48 become 11 × 11, 4 × 4 and 2 × 2.
    """

    def __init__(self, codec: MapCodec) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(codec.network_channels, 32, 8, stride=4)
        self.conv2 = nn.Conv2d(32, 64, 4, stride=2)
        self.conv3 = nn.Conv2d(64, 64, 3)
        size = (codec.height, codec.width)
        rows, columns = (((pixels - 8) // 4 + 1 - 4) // 2 + 1 - 2 for pixels in size)
        self.linear = nn.Linear(64 * rows * columns, EMBEDDING_SIZE)

    def forward(self, image: Tensor) -> Tensor:
        """Returns the embeddings `[N, 512]`, in the dtype of the map."""
        with _autocast_like(image):
            x = image
            for convolution in (self.conv1, self.conv2, self.conv3):
                x = F.leaky_relu_(convolution(x))
            # [N, 64, h, w] to [N, h * w * 64]: a view, because the map is channels-last in memory.
            return F.leaky_relu_(self.linear(x.permute(0, 2, 3, 1).flatten(1)))


class Encoder(nn.Module):
    """Concatenates the embeddings of several maps, which have a `NatureEncoder` each.

    With `layer_norm`, each embedding has mean 0 and variance 1 (without learnt weights), so that
    all maps have the same scale in the head's input throughout training.
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
        """Returns the embeddings `[N, 512 * maps]` of decoded maps, in the maps' order."""
        embeddings = [encoder(image) for encoder, image in zip(self.encoders, images)]
        if self.layer_norm:
            embeddings = [F.layer_norm(x, x.shape[-1:]) for x in embeddings]
        return torch.cat(embeddings, dim=-1)


class Head(nn.Module):
    """Maps `[N, embedding]` to `[N, outputs]` float32: linear, SiLU, linear."""

    def __init__(self, embedding_size: int, hidden_size: int, outputs: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(embedding_size, hidden_size)
        self.output = nn.Linear(hidden_size, outputs)

    def forward(self, embedding: Tensor) -> Tensor:
        """Returns one float32 number per output."""
        with _autocast_like(embedding):
            hidden = F.silu(self.hidden(embedding))
        # float32, because small differences between outputs decide which action is chosen.
        return self.output(hidden.float())


def heads_together(embedding: Tensor, weights: Mapping[str, Any]) -> Tensor:
    """Returns the outputs `[heads, N, outputs]` of several heads on one embedding `[N, size]`.

    `weights` are those of `Head` by module and name, stacked along a first dim of heads: for
    example, `["hidden"]["weight"]` is `[heads, hidden, size]`.
    """
    hidden, output = weights["hidden"], weights["output"]
    # All hidden layers are one product, [N, size] · [size, heads * hidden]; TorchRL would use vmap.
    with _autocast_like(embedding):
        x = F.silu(F.linear(embedding, hidden["weight"].flatten(0, 1), hidden["bias"].flatten()))
    # [N, heads * hidden] to [heads, N, hidden]
    x = x.float().unflatten(-1, hidden["bias"].shape).movedim(-2, 0)
    return torch.baddbmm(output["bias"].unsqueeze(-2), x, output["weight"].mT)


class MapNetwork(nn.Module):
    """Maps decoded maps to `[N, outputs]` float32: an `Encoder`, then a `Head`."""

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

    def forward(self, images: Sequence[Tensor]) -> Tensor:
        """Returns `[N, outputs]`."""
        return self.head(self.encoder(images))

    def another(self, outputs: int) -> MapNetwork:
        """Returns a network for the same maps and sizes with new weights."""
        layer_norm = self.encoder.layer_norm
        return MapNetwork(self.codecs, self.hidden_size, outputs, layer_norm=layer_norm)


class PolicyNetwork(nn.Module):
    """Maps raw or stored maps `[*B, C, H, W]`, one argument each, to `[*B, outputs]`.

    Raw maps are first rounded as in the replay memory, so that the agent sees the same values when
    it acts and when it learns.

    Attributes:
        mirror: with a `flowrep.transforms.Mirror` of the maps, the output is the mean of log π of
            the maps and of their mirror image, so that what isn't symmetric in a network's errors
            cancels.
    """

    def __init__(self, network: MapNetwork) -> None:
        super().__init__()
        self.mirror: Any = None
        self.codecs, self.network = network.codecs, network

    def forward(self, *maps: Tensor) -> Tensor:
        """Returns the network's output."""
        output = self._output(maps)
        if self.mirror is None:
            return output
        image = self._output(self.mirror.images_of(maps))[..., self.mirror.swapped_actions]
        return (output.log_softmax(-1) + image.log_softmax(-1)) / 2

    def _output(self, maps: Sequence[Tensor]) -> Tensor:
        batch = maps[0].shape[:-3]
        stored = [codec.store(x).reshape(-1, *x.shape[-3:]) for codec, x in zip(self.codecs, maps)]
        outputs = self.network([codec.decode(x) for codec, x in zip(self.codecs, stored)])
        return outputs.reshape(*batch, outputs.shape[-1])


def stochastic_policy(
    network: nn.Module, in_keys: Sequence[NestedKey], *, writes_log_prob: bool = False
) -> ProbabilisticTensorDictSequential:
    """Returns a module that writes `action`, drawn from the softmax of the network's logits.

    With `writes_log_prob` it also writes `action_log_prob`. Under TorchRL's
    `set_exploration_type(ExplorationType.DETERMINISTIC)` it takes the most probable action instead.
    """
    draw = ProbabilisticTensorDictModule(
        in_keys=["logits"],
        out_keys=["action"],
        distribution_class=torch.distributions.Categorical,
        distribution_kwargs={"validate_args": False},
        default_interaction_type=InteractionType.RANDOM,
        return_log_prob=writes_log_prob,
        log_prob_key="action_log_prob",
    )
    logits = TensorDictModule(network, in_keys=list(in_keys), out_keys=["logits"])
    written = ["action", "action_log_prob"] if writes_log_prob else ["action"]
    return ProbabilisticTensorDictSequential(logits, draw).select_out_keys(*written)
