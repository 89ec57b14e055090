"""The small network that turns an embedding into one number an action."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from flowrep.agent.encoder import linear


class Head(nn.Module):
    """Returns `[N, n_actions]` float32 of `[N, embedding]`: linear, Swish, linear.

    The hidden layer computes in the dtype of its input, the output layer in float32.
    """

    def __init__(self, embedding_size: int, hidden_size: int, n_actions: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(embedding_size, hidden_size)
        self.output = nn.Linear(hidden_size, n_actions)

    def forward(self, embedding: Tensor) -> Tensor:
        """Returns one float32 number an action."""
        hidden = F.silu(linear(embedding, self.hidden))
        return self.output(hidden.float())
