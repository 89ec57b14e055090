"""Base class of algorithms that learn from a replay memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform

from flowrep.agent.algorithm import Algorithm
from flowrep.agent.networks import DiscreteActions
from flowrep.agent.observation import MapCodec
from flowrep.agent.replay import OUTCOME, ReplayMemory
from flowrep.options import AlgorithmOptions, OffPolicyOptions


def transition_keys(codecs: Sequence[MapCodec]) -> list[NestedKey]:
    """Returns the keys of a sampled transition that a loss reads."""
    maps = [codec.key for codec in codecs]
    following = [unravel_key(("next", key)) for key in (*maps, *OUTCOME)]
    return [*maps, "action", "steps_to_next_obs", *following]


def td_target(batch: TensorDictBase, next_value: Tensor, gamma: float) -> Tensor:
    """Returns r + γⁿ (1 - terminated) V(s') `[N]` of sampled transitions, given V(s') `[N, 1]`."""
    outcome = batch["next"]
    # Masked instead of multiplied, because the value after an end may be nan.
    next_value = next_value.masked_fill(outcome["terminated"], 0.0)
    discount = gamma ** batch["steps_to_next_obs"]
    return (outcome["reward"] + discount * next_value).squeeze(-1)


class OffPolicy(Algorithm):
    """Takes one update every `frames_per_update` frames, on a uniform sample of recent frames.

    Args:
        observation_spec: the last three dims of each map are C, H, W.
        action_spec: `Categorical` or `OneHot`.
        keys: the observation maps to read, in order.
        options: an instance of the class's `OPTIONS`.
        total_frames: frames of the whole training, at whose end the learning rate is 0.
        device: the device of networks and replay memory.
        mirror_image: for the option `mirror`, the transform that replaces half of each sampled
            batch by mirror images, such as `flowrep.transforms.Mirror`.
    """

    OPTIONS: ClassVar[type[AlgorithmOptions]] = OffPolicyOptions
    options: Any
    memory: ReplayMemory

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        options: OffPolicyOptions,
        *,
        total_frames: int,
        device: torch.device | str = "cpu",
        mirror_image: Transform | None = None,
    ) -> None:
        self.options = options
        self.policy = self.make_policy(
            observation_spec, action_spec, keys, options, total_frames=total_frames, device=device
        )
        network = self.policy[0].module.network
        self.codecs = network.codecs
        loss = self.LOSS(network, DiscreteActions.from_spec(action_spec), options)
        starts = options.learning_starts
        self.learning_starts = options.batch_size if starts is None else starts
        super().__init__(
            loss,
            tau=options.tau,
            learning_rate=options.learning_rate,
            total_updates=(total_frames - self.learning_starts) // options.frames_per_update,
        )
        self.memory = ReplayMemory(
            self.codecs,
            capacity=options.replay_capacity,
            batch_size=options.batch_size,
            device=device,
            n_steps=options.n_steps,
            gamma=options.gamma,
        )
        if options.mirror:
            if mirror_image is None:
                raise ValueError("mirror=True needs mirror_image, a transform of sampled batches")
            self.memory.append_transform(mirror_image)

    def updates_due(self, frames: int) -> int:
        """Returns how many updates are due after `frames` frames, minus those already taken."""
        allowed = max(0, frames - self.learning_starts) // self.options.frames_per_update
        return allowed - self.updates

    def sample(self) -> TensorDictBase:
        """Returns a sample of the replay memory."""
        return self.memory.sample()
