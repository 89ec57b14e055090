"""Discrete soft actor-critic from maps: TorchRL's loss on embeddings that are computed once."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.objectives import DiscreteSACLoss, SoftUpdate, ValueEstimators

from flowrep.agent.action import DiscreteActions
from flowrep.agent.encoder import Encoder
from flowrep.agent.heads import Head
from flowrep.agent.observation import decode_maps, map_codecs
from flowrep.agent.policy import PolicyNetwork, stochastic_policy
from flowrep.agent.precision import compute_dtype
from flowrep.agent.replay import ReplayMemory

ENCODERS = ("shared", "separate")


class DiscreteSAC:
    """Actor, two Q-functions and their targets, trained by discrete soft actor-critic.

    One gradient step minimises, over a batch and with π, Q1, Q2 from the embeddings of `s` and `s'`
    (the paper's Eqs. 2-5 without its state-value network):

        y   = r + γ (1 - terminated) Σ_a π(a|s') [min_i Q̄_i(s', a) - α log π(a|s')]
        L_Q = mean (Q1(s, a) - y)² + mean (Q2(s, a) - y)²
        L_π = mean Σ_a π(a|s) [α log π(a|s) - min_i Q_i(s, a)]
        L_α = mean -log α (Σ_a π(a|s) log π(a|s) + H̄),   H̄ = target_entropy_weight · log n

    All gradients are taken at the same weights, then Adam steps once, then the targets move by
    `tau`. ML-Agents halves L_Q (which Adam does not feel, but for its epsilon) and uses Q1 alone
    in L_π.

    Args:
        observation_spec: the environment's; its last three dims of each map are C, H, W.
        action_spec: `Categorical` or `OneHot`.
        keys: the observation maps to read, in order.
        total_frames: environment frames of the whole training; sets the learning rate's end.
        device: where networks, replay and updates live.
        encoder: `"shared"`: policy and Q-functions read one set of encoders, trained by L_Q alone;
            `"separate"`: each its own.
        precision: `"auto"`, `"bf16"` or `"fp32"`; weights are float32 in each case.
        learning_rate: Adam's for all weights and log α, falling linearly to 0.
        initial_alpha: α before the first update.
        target_entropy_weight: share of the largest entropy, log n, that α steers to.
        gamma: discount a frame.
        tau: share of the online weights in each move of the targets.
        hidden_size: width of the one hidden layer after the embeddings.
        batch_size: transitions an update.
        replay_capacity: transitions kept.
        frames_per_update: environment frames for each gradient step.
        learning_starts: frames before the first update; None: one batch.
    """

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        *,
        total_frames: int,
        device: torch.device | str,
        encoder: str,
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
    ) -> None:
        if encoder not in ENCODERS:
            raise ValueError(f"encoder={encoder!r}: expected one of {', '.join(ENCODERS)}")
        self.device = torch.device(device)
        self.dtype = compute_dtype(precision, self.device)
        self.codecs = map_codecs(observation_spec, keys, self.dtype)
        self.learning_rate = learning_rate
        self.updates = 0
        self.replay = ReplayMemory(
            self.codecs,
            capacity=replay_capacity,
            batch_size=batch_size,
            frames_per_update=frames_per_update,
            learning_starts=batch_size if learning_starts is None else learning_starts,
            device=self.device,
        )
        learning_frames = total_frames - self.replay.learning_starts
        self.total_updates = max(1, learning_frames // frames_per_update)

        actions = DiscreteActions.from_spec(action_spec)
        with self.device:
            self.critic_encoder = Encoder(self.codecs)
            self.encoder_is_shared = encoder == "shared"
            self.actor_encoder = (
                self.critic_encoder if self.encoder_is_shared else Encoder(self.codecs)
            )
            sizes = (self.critic_encoder.embedding_size, hidden_size, actions.count)
            actor_head, critic_head = Head(*sizes), Head(*sizes)
        self.target_encoder = copy.deepcopy(self.critic_encoder).requires_grad_(False)
        network = PolicyNetwork(self.codecs, self.actor_encoder, actor_head)
        self.policy = stochastic_policy(network, list(keys), actions)
        self.loss = DiscreteSACLoss(
            stochastic_policy(actor_head, ["actor_embedding"], actions),
            TensorDictModule(critic_head, ["critic_embedding"], ["action_value"]),
            action_space=actions.space,
            num_actions=actions.count,
            loss_function="l2",
            alpha_init=initial_alpha,
            target_entropy="auto",
            target_entropy_weight=target_entropy_weight,
            # for two small heads a loop is as fast as vmap, and asks nothing of what they do
            deactivate_vmap=True,
        )
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.tau = tau
        self._move_target_heads = SoftUpdate(self.loss, tau=tau)
        self._weights = dict(self._named_weights())
        self.trained = {n: w for n, w in self._weights.items() if w.requires_grad}
        self.optimizer = torch.optim.Adam(self.trained.values(), lr=learning_rate, fused=True)

    def update(self, batch: TensorDictBase) -> TensorDictBase:
        """Takes one gradient step on a batch from `replay.sample()`; returns detached metrics."""
        learning_rate = self.learning_rate * max(0.0, 1 - self.updates / self.total_updates)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        self.optimizer.zero_grad(set_to_none=True)
        losses = self.losses(batch)
        (losses["q_loss"] + losses["actor_loss"] + losses["alpha_loss"]).backward()
        self.optimizer.step()
        self._move_targets()
        self.updates += 1
        metrics = TensorDict({name: value.detach() for name, value in losses.items()})
        gradients = [w.grad for w in self.trained.values() if w.grad is not None]
        metrics["grad_norm"] = torch.nn.utils.get_total_norm(gradients)
        metrics["learning_rate"] = torch.tensor(learning_rate)
        return metrics

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Returns the three losses, with gradients, and what they were computed from, without."""
        embedded = self._embed(batch)
        q_loss, critic_info = self.loss.qvalue_loss(embedded)
        # the policy loss must not reach the critic's encoder through Q(s, a)
        embedded["critic_embedding"] = embedded["critic_embedding"].detach()
        actor_loss, actor_info = self.loss.actor_loss(embedded)
        negative_entropy = actor_info["log_prob"]
        alpha = self.loss.log_alpha.detach().exp()
        entropy = -negative_entropy.mean()
        return {
            "q_loss": q_loss,
            "actor_loss": actor_loss,
            "alpha_loss": self.loss.alpha_loss(negative_entropy).mean(),
            "alpha": alpha,
            "entropy": entropy,
            # L_π = -α · entropy - mean Σ_a π min_i Q_i
            "q_mean": -(actor_loss.detach() + alpha * entropy),
            "td_error": critic_info["td_error"].mean(),
        }

    def _embed(self, batch: TensorDictBase) -> TensorDict:
        """Returns the batch with maps replaced by embeddings; each encoder reads each map once."""
        images = decode_maps(self.codecs, batch)
        critic = self.critic_encoder(images)
        actor = critic.detach() if self.encoder_is_shared else self.actor_encoder(images)
        with torch.no_grad():
            images = decode_maps(self.codecs, batch["next"])
            following = batch["next"].select("reward", "done", "terminated")
            following["actor_embedding"] = self.actor_encoder(images)
            following["critic_embedding"] = self.target_encoder(images)
        return TensorDict(
            {
                "actor_embedding": actor,
                "critic_embedding": critic,
                "action": batch["action"],
                "next": following,
            },
            batch.batch_size,
        )

    @torch.no_grad()
    def _move_targets(self) -> None:
        self._move_target_heads.step()
        torch._foreach_lerp_(
            list(self.target_encoder.parameters()), list(self.critic_encoder.parameters()), self.tau
        )

    def _named_weights(self) -> list[tuple[str, Tensor]]:
        """Returns all that training changes: weights, target weights, log α."""
        encoders = {"critic_encoder": self.critic_encoder, "target_encoder": self.target_encoder}
        if not self.encoder_is_shared:
            encoders["actor_encoder"] = self.actor_encoder
        named = [
            (f"{prefix}.{name}", weight)
            for prefix, encoder in encoders.items()
            for name, weight in encoder.named_parameters()
        ]
        buffers = self.loss.named_buffers()
        targets = (item for item in buffers if item[0].startswith("target_qvalue"))
        return [*named, *self.loss.named_parameters(), *targets]

    def state_dict(self) -> dict[str, Any]:
        """Returns weights, targets, log α, Adam's moments and the schedule's position."""
        moments = {n: dict(self.optimizer.state[w]) for n, w in self.trained.items()}
        return {
            "weights": {name: weight.detach() for name, weight in self._weights.items()},
            "moments": moments if self.updates else {},
            "updates": self.updates,
        }

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state_dict`.

        Raises:
            ValueError: if it belongs to other maps, sizes or another `encoder`.
        """
        saved = state["weights"]
        shapes = {name: tuple(weight.shape) for name, weight in self._weights.items()}
        differing = [
            f"{name}: {shapes.get(name, 'absent')} here, "
            f"{tuple(saved[name].shape) if name in saved else 'absent'} there"
            for name in sorted(shapes.keys() | saved.keys())
            if name not in saved or shapes.get(name) != tuple(saved[name].shape)
        ]
        if differing:
            raise ValueError(
                f"the saved agent does not fit this one in {len(differing)} weights, first "
                f"{differing[0]}; use the representations, image size and encoder it was made with"
            )
        for name, weight in self._weights.items():
            weight.copy_(saved[name])
        for name, moments in state["moments"].items():
            weight = self.trained[name]
            self.optimizer.state[weight] = {
                key: value.to(weight.device, copy=True) for key, value in moments.items()
            }
        self.updates = state["updates"]
