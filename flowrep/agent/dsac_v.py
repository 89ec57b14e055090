"""Discrete soft actor-critic with a state-value network: the paper's Eqs. 2-5 as its trainer's."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, OneHot, TensorSpec

from flowrep.agent.action import DiscreteActions
from flowrep.agent.algorithm import move_targets, named_weights
from flowrep.agent.observation import decode_maps, map_codecs
from flowrep.agent.off_policy import OffPolicy
from flowrep.agent.policy import MapNetwork
from flowrep.agent.precision import compute_dtype


class DiscreteSACWithValue(OffPolicy):
    """Actor, two Q-functions, a state-value function V and its target V̄, sharing no weights.

    One gradient step minimises, over a batch and with Q_i(s, π) = Σ_a π(a|s) Q_i(s, a):

        y   = r + γ (1 - terminated) V̄(s')
        L_Q = ½ mean (Q1(s, a) - y)² + ½ mean (Q2(s, a) - y)²
        L_V = ½ mean (V(s) - min(Q1(s, π), Q2(s, π)) + α Σ_a π(a|s) log π(a|s))²
        L_π = mean Σ_a π(a|s) [α log π(a|s) - Q1(s, a)]
        L_α = mean -log α (Σ_a π(a|s) log π(a|s) + H̄),   H̄ = target_entropy_weight · log n

    Each loss trains its own network alone. All gradients are taken at the same weights, then Adam
    steps once, then V̄ moves by `tau`. This is what the paper's trainer, ML-Agents, computes; it
    costs five sets of encoders where `DiscreteSAC` with a shared one has two.

    Args:
        observation_spec: the environment's; its last three dims of each map are C, H, W.
        action_spec: `Categorical` or `OneHot`.
        keys: the observation maps to read, in order.
        total_frames: environment frames of the whole training; sets the learning rate's end.
        device: where networks, replay and updates live.
        precision: `"auto"`, `"bf16"` or `"fp32"`; weights are float32 in each case.
        learning_rate: Adam's for all weights and log α, falling linearly to 0.
        initial_alpha: α before the first update.
        target_entropy_weight: share of the largest entropy, log n, that α steers to.
        gamma: discount a frame.
        tau: share of the online weights in each move of the target.
        hidden_size: width of the one hidden layer after the embeddings.
        batch_size: transitions an update.
        replay_capacity: transitions kept.
        frames_per_update: environment frames for each gradient step.
        learning_starts: frames before the first update; None: one batch.
        n_steps: frames that a transition spans: r becomes the discounted sum of its rewards,
            without the entropy bonus on the way, and γ becomes γ to that power.
        layer_norm: normalise each map's embedding, see `Encoder`.
        alpha_rate_factor: the learning rate of log α is so many times that of the weights.
    """

    METRICS = (
        "q_loss", "value_loss", "actor_loss", "alpha_loss", "alpha", "entropy", "q_mean",
        "value_mean",
    )  # fmt: skip

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        *,
        total_frames: int,
        device: torch.device | str,
        precision: str,
        learning_rate: float,
        initial_alpha: float,
        target_entropy_weight: float,
        gamma: float,
        tau: float,
        hidden_size: int,
        batch_size: int,
        replay_capacity: int,
        frames_per_update: int,
        learning_starts: int | None,
        n_steps: int = 1,
        layer_norm: bool = False,
        alpha_rate_factor: float = 1.0,
    ) -> None:
        device = torch.device(device)
        self.codecs = map_codecs(observation_spec, keys, compute_dtype(precision, device))
        actions = DiscreteActions.from_spec(action_spec)
        self.actions_are_one_hot = isinstance(action_spec, OneHot)
        self.gamma, self.tau = gamma, tau
        self.target_entropy = target_entropy_weight * math.log(actions.count)
        self.policy = self.build_policy(
            observation_spec,
            action_spec,
            keys,
            device=device,
            precision=precision,
            hidden_size=hidden_size,
            layer_norm=layer_norm,
        )
        self.actor = self.policy[0].module.network
        with device:
            self.q1, self.q2 = (
                MapNetwork(self.codecs, hidden_size, actions.count, layer_norm=layer_norm)
                for _ in range(2)
            )
            self.value = MapNetwork(self.codecs, hidden_size, 1, layer_norm=layer_norm)
            self.log_alpha = torch.nn.Parameter(torch.tensor(math.log(initial_alpha)))
        self.target_value = copy.deepcopy(self.value).requires_grad_(False)
        super().__init__(
            named_weights(
                actor=self.actor,
                q1=self.q1,
                q2=self.q2,
                value=self.value,
                target_value=self.target_value,
            )
            | {"log_alpha": self.log_alpha},
            self.codecs,
            device,
            total_frames=total_frames,
            learning_rate=learning_rate,
            batch_size=batch_size,
            replay_capacity=replay_capacity,
            frames_per_update=frames_per_update,
            learning_starts=learning_starts,
            gamma=gamma,
            n_steps=n_steps,
            rate_factors={"log_alpha": alpha_rate_factor},
        )

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Returns the four losses, with gradients, and what they were computed from, without."""
        images = decode_maps(self.codecs, batch)
        outcome, action = batch["next"], batch["action"]
        if self.actions_are_one_hot:
            action = action.to(torch.uint8).argmax(-1)
        alpha = self.log_alpha.detach().exp()

        log_policy = self.actor(images).log_softmax(-1)
        policy = log_policy.exp()
        negative_entropy = (policy * log_policy).sum(-1)
        q1, q2 = self.q1(images), self.q2(images)
        value = self.value(images).squeeze(-1)
        with torch.no_grad():
            following = self.target_value(decode_maps(self.codecs, outcome))
            # a masked value, not a product: what lies after an end may be anything
            following = following.masked_fill(outcome["terminated"], 0.0)
            discount = self.gamma ** batch["steps_to_next_obs"]
            y = (outcome["reward"] + discount * following).squeeze(-1)
            expected_q = torch.minimum((policy * q1).sum(-1), (policy * q2).sum(-1))
            value_target = expected_q - alpha * negative_entropy
        chosen = (q.gather(-1, action.unsqueeze(-1)).squeeze(-1) for q in (q1, q2))
        return {
            "q_loss": 0.5 * sum(F.mse_loss(q, y) for q in chosen),
            "value_loss": 0.5 * F.mse_loss(value, value_target),
            "actor_loss": (policy * (alpha * log_policy - q1.detach())).sum(-1).mean(),
            "alpha_loss": -self.log_alpha
            * (negative_entropy.detach() + self.target_entropy).mean(),
            "alpha": alpha,
            "entropy": -negative_entropy.mean(),
            "q_mean": expected_q.mean(),
            "value_mean": value.mean(),
        }

    def after_update(self) -> None:
        """Moves V̄ by `tau` of its distance to V."""
        move_targets(self.target_value.parameters(), self.value.parameters(), self.tau)
