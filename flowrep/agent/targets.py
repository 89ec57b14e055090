"""Target networks, which follow the trained ones."""

from __future__ import annotations

import torch
from torchrl.objectives import LossModule, SoftUpdate


class FastSoftUpdate(SoftUpdate):
    """TorchRL's `SoftUpdate`, which lists the weights once instead of at every step.

    Args:
        loss: has target parameters.
        tau: share of the weights in each move of the targets.
    """

    def __init__(self, loss: LossModule, *, tau: float) -> None:
        super().__init__(loss, tau=tau)
        targets = dict(self._targets.flatten_keys(".").items())
        weights = self._sources.flatten_keys(".")
        self._moved = [*targets.values()]
        self._followed = [weights[name.removeprefix("target_")] for name in targets]

    @torch.no_grad()
    def step(self) -> None:
        """Moves each target towards its weight."""
        torch._foreach_lerp_(self._moved, self._followed, 1 - self.eps)
