"""The small network that maps an embedding to one number per action."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from flowrep.agent.encoder import linear


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
