"""What algorithms that learn from a replay memory have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flowrep.agent.algorithm import Algorithm
from flowrep.agent.observation import MapCodec
from flowrep.agent.replay import ReplayMemory


class OffPolicy(Algorithm):
    """One update every `frames_per_update` frames, on a uniform sample of the last frames.

    Args:
        weights: as `Algorithm` takes them.
        codecs: the maps to keep.
        device: where they are kept.
        total_frames: environment frames of the whole training; sets the learning rate's end.
        learning_rate: Adam's, falling linearly to 0.
        batch_size: transitions an update.
        replay_capacity: transitions kept.
        frames_per_update: environment frames for each gradient step.
        learning_starts: frames before the first update; None: one batch.
        gamma: discount a frame, of the rewards within a sampled transition.
        n_steps: frames that a sampled transition spans; see `ReplayMemory`.
        rate_factors: as `Algorithm` takes them.
    """

    memory: ReplayMemory

    def __init__(
        self,
        weights: Mapping[str, Tensor],
        codecs: Sequence[MapCodec],
        device: torch.device,
        *,
        total_frames: int,
        learning_rate: float,
        batch_size: int,
        replay_capacity: int,
        frames_per_update: int,
        learning_starts: int | None,
        gamma: float = 1.0,
        n_steps: int = 1,
        rate_factors: Mapping[str, float] | None = None,
    ) -> None:
        self.frames_per_update = frames_per_update
        self.learning_starts = batch_size if learning_starts is None else learning_starts
        super().__init__(
            weights,
            learning_rate=learning_rate,
            total_updates=(total_frames - self.learning_starts) // frames_per_update,
            rate_factors=rate_factors,
        )
        self.memory = ReplayMemory(
            codecs,
            capacity=replay_capacity,
            batch_size=batch_size,
            device=device,
            n_steps=n_steps,
            gamma=gamma,
        )

    def updates_due(self, frames: int) -> int:
        """Returns how many updates the frames so far allow, beyond those taken."""
        return max(0, frames - self.learning_starts) // self.frames_per_update - self.updates

    def sample(self) -> TensorDictBase:
        """Returns `batch_size` transitions, uniform with replacement, maps packed."""
        return self.memory.sample()
