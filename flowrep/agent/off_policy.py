"""Base class of algorithms that learn from a replay memory."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform

from flowrep.agent.algorithm import Algorithm
from flowrep.agent.networks import DiscreteActions
from flowrep.agent.observation import MapCodec
from flowrep.agent.replay import OUTCOME, ReplayMemory


class PersistentExploration:
    """Temporally extended ε-greedy exploration, "εz-greedy" (Dabney et al. 2020, arXiv:2006.01782).

    With probability ε an environment begins to repeat an action that is drawn uniformly, for n
    steps, P(n) ∝ n⁻², at most 24 (two seconds of driving). Single random actions cancel each other;
    repeated ones take a turn that the policy avoids. ε falls linearly from `epsilon` to 0 over the
    `total_frames` of all environments.
    """

    LONGEST = 24

    def __init__(
        self,
        epsilon: float,
        total_frames: int,
        num_envs: int,
        actions: DiscreteActions,
        device: torch.device,
    ) -> None:
        self.epsilon, self.total_frames, self.actions = epsilon, total_frames, actions
        self._length_weights = torch.arange(1.0, self.LONGEST + 1, device=device) ** -2
        # the longest stands for all that would be longer
        self._length_weights[-1] = math.pi**2 / 6 - self._length_weights[:-1].sum()
        sizes = {"steps_left": (num_envs,), "repeated_action": (num_envs,), "frames_acted": ()}
        self.state = {
            name: torch.zeros(size, dtype=torch.long, device=device) for name, size in sizes.items()
        }

    def __call__(self, acted: TensorDictBase) -> TensorDictBase:
        """Replaces actions of environments `[N]`, whose episodes begin where `is_init`."""
        steps_left, repeated, frames = self.state.values()
        epsilon = self.epsilon * (1 - frames / self.total_frames)
        frames += len(steps_left)
        steps_left.masked_fill_(acted["is_init"].flatten(), 0)
        begins = (steps_left == 0) & (torch.rand_like(steps_left, dtype=torch.float) < epsilon)
        lengths = 1 + torch.multinomial(self._length_weights, len(begins), replacement=True)
        steps_left.copy_(torch.where(begins, lengths, steps_left))
        drawn = torch.randint_like(repeated, self.actions.count)
        repeated.copy_(torch.where(begins, drawn, repeated))
        # a length of n covers this step and the n - 1 that follow
        own, other, repeats = acted["action"], repeated, steps_left > 0
        if self.actions.space == "one-hot":
            other, repeats = F.one_hot(other, self.actions.count), repeats.unsqueeze(-1)
        steps_left.sub_(1).clamp_(min=0)
        return acted.set("action", torch.where(repeats, other.to(own.dtype), own))


def transition_keys(codecs: Sequence[MapCodec]) -> list[NestedKey]:
    """Returns the keys of a sampled transition that a loss reads."""
    maps = [codec.key for codec in codecs]
    following = [unravel_key(("next", key)) for key in (*maps, *OUTCOME)]
    return [*maps, "action", "steps_to_next_obs", *following]


def td_target(batch: TensorDictBase, next_value: Tensor, gamma: float) -> Tensor:
    """Returns r + γⁿ (1 - terminated) V(s') `[N]` of sampled transitions, given V(s') `[N, 1]`."""
    outcome = batch["next"]
    # masked instead of multiplied: the value after an end may even be nan
    next_value = next_value.masked_fill(outcome["terminated"], 0.0)
    discount = gamma ** batch["steps_to_next_obs"]
    return (outcome["reward"] + discount * next_value).squeeze(-1)


class OffPolicy(Algorithm):
    """Takes one update every `frames_per_update` frames, on a uniform sample of recent frames.

    Args:
        observation_spec: the last three dims of each map are C, H, W.
        action_spec: `Categorical` or `OneHot`.
        keys: the observation maps to read, in order.
        total_frames: environment frames over the training, at whose end the learning rate is 0.
        device: where networks, replay and updates live.
        precision: `"auto"`, `"bf16"` or `"fp32"`; weights are float32 in each case.
        learning_rate: see `Algorithm`, as for `tau` and `rate_factors`.
        gamma: discount per frame.
        hidden_size: width of the single hidden layer after the embeddings.
        frames_per_update: environment frames per gradient step.
        learning_starts: frames before the first update; None for one batch.
        n_steps: frames that a transition spans: r becomes the discounted sum of its rewards, and γ
            becomes γ to that power.
        layer_norm: normalise each map's embedding, see `Encoder`.
        mirror: replace half of each batch by its left-right images, with `mirror_image`, a
            transform of sampled batches such as `flowrep.transforms.Mirror`.
        persistent_exploration: ε of `PersistentExploration` at the start.
        policy_options: further arguments of `make_policy`.
        loss_options: arguments of `LOSS` besides `gamma`.
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
        persistent_exploration: float = 0.0,
        rate_factors: Mapping[str, float] | None = None,
        policy_options: Mapping[str, Any] | None = None,
        **loss_options: Any,
    ) -> None:
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
        self.codecs = network.codecs
        self.persistence: PersistentExploration | None = None
        if persistent_exploration > 0:
            num_envs = observation_spec.shape.numel()
            self.persistence = PersistentExploration(
                persistent_exploration, total_frames, num_envs, actions, torch.device(device)
            )
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

    def act(self, observation: TensorDictBase) -> TensorDictBase:
        """Returns the policy's actions, some of them replaced by persistent exploration."""
        acted = super().act(observation)
        return acted if self.persistence is None else self.persistence(acted)

    def other_weights(self) -> Mapping[str, Tensor]:
        """Returns the state of the persistent exploration, if there is any."""
        return {} if self.persistence is None else self.persistence.state

    def updates_due(self, frames: int) -> int:
        """Returns how many updates `frames` frames allow, less those already taken."""
        return max(0, frames - self.learning_starts) // self.frames_per_update - self.updates

    def sample(self) -> TensorDictBase:
        """Returns a sample of the replay memory."""
        return self.memory.sample()
