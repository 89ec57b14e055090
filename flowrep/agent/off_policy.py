"""Base class of algorithms that learn from a replay memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform

from flowrep.agent.algorithm import Algorithm
from flowrep.agent.networks import DiscreteActions
from flowrep.agent.observation import compute_dtype, map_codecs
from flowrep.agent.replay import ReplayMemory


class OffPolicy(Algorithm):
    """Takes one update every `frames_per_update` frames, on a uniform sample of recent frames.

    Args:
        observation_spec: the environment's; the last three dims of each map are C, H, W.
        action_spec: `Categorical` or `OneHot`.
        keys: the observation maps to read, in order.
        total_frames: environment frames over the whole training, after which the learning rate
            is 0.
        device: where networks, replay and updates live.
        precision: `"auto"`, `"bf16"` or `"fp32"`; weights are float32 in each case.
        learning_rate: Adam's for all weights, falling linearly to 0.
        gamma: discount per frame.
        tau: share of the online weights in each move of the targets.
        hidden_size: width of the single hidden layer after the embeddings.
        batch_size: transitions per update.
        replay_capacity: transitions kept.
        frames_per_update: environment frames per gradient step.
        learning_starts: frames before the first update; None for one batch.
        n_steps: frames that a transition spans: r becomes the discounted sum of its rewards, and γ
            becomes γ to that power.
        layer_norm: normalise each map's embedding, see `Encoder`.
        mirror: replace half of each batch by its left-right images, with `mirror_image`.
        mirror_image: TorchRL transform that does so with a batch, maps in their stored form; for
            what it has to know of maps, camera and actions, it comes from where they are known.
        rate_factors: see `Algorithm`.
        policy_options: further arguments of `make_policy`.
        loss_options: arguments of `LOSS` besides `gamma`.

    Raises:
        ValueError: if `mirror` is set without `mirror_image`.
    """

    memory: ReplayMemory

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        *,
        total_frames: int,
        device: torch.device | str = "cpu",
        precision: str = "auto",
        learning_rate: float = 3e-4,
        gamma: float = 0.99,
        tau: float = 0.005,
        hidden_size: int = 512,
        batch_size: int = 1024,
        replay_capacity: int = 10_240,
        frames_per_update: int = 10,
        learning_starts: int | None = None,
        n_steps: int = 1,
        layer_norm: bool = False,
        mirror: bool = False,
        mirror_image: Transform | None = None,
        rate_factors: Mapping[str, float] | None = None,
        policy_options: Mapping[str, Any] | None = None,
        **loss_options: Any,
    ) -> None:
        device = torch.device(device)
        self.codecs = map_codecs(observation_spec, keys, compute_dtype(precision, device))
        self.policy = self.make_policy(
            observation_spec,
            action_spec,
            keys,
            device=device,
            precision=precision,
            hidden_size=hidden_size,
            layer_norm=layer_norm,
            **(policy_options or {}),
        )
        network, actions = self.policy[0].module.network, DiscreteActions.from_spec(action_spec)
        loss = self.LOSS(network, actions, gamma=gamma, **loss_options)
        self.frames_per_update = frames_per_update
        self.learning_starts = batch_size if learning_starts is None else learning_starts
        super().__init__(
            loss,
            tau=tau,
            learning_rate=learning_rate,
            total_updates=(total_frames - self.learning_starts) // frames_per_update,
            rate_factors=rate_factors,
        )
        self.memory = ReplayMemory(
            self.codecs,
            capacity=replay_capacity,
            batch_size=batch_size,
            device=device,
            n_steps=n_steps,
            gamma=gamma,
        )
        if mirror:
            if mirror_image is None:
                raise ValueError("mirror=True needs mirror_image, a transform of sampled batches")
            self.memory.append_transform(mirror_image)

    def updates_due(self, frames: int) -> int:
        """Returns how many updates `frames` frames allow, less those already taken."""
        return max(0, frames - self.learning_starts) // self.frames_per_update - self.updates

    def sample(self) -> TensorDictBase:
        """Returns `batch_size` transitions, uniform with replacement, maps in their stored form."""
        return self.memory.sample()
