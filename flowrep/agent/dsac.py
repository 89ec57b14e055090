"""Discrete soft actor-critic from maps: TorchRL's loss on embeddings that are computed once."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.objectives import SoftUpdate, ValueEstimators

from flowrep.agent.action import DiscreteActions
from flowrep.agent.algorithm import move_targets, named_weights
from flowrep.agent.dsac_loss import DiscreteSACHeadsLoss
from flowrep.agent.encoder import Encoder
from flowrep.agent.heads import Head
from flowrep.agent.observation import decode_maps, map_codecs
from flowrep.agent.off_policy import OffPolicy
from flowrep.agent.policy import stochastic_policy
from flowrep.agent.precision import compute_dtype

ENCODERS = ("shared", "separate")


class DiscreteSAC(OffPolicy):
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
        encoder: `"shared"`: policy and Q-functions read one set of encoders, trained by L_Q alone,
            and in y both read its target, so that each observation is encoded once; `"separate"`:
            each its own, and π(·|s') in y reads the policy's.
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
        n_steps: frames that a transition spans: r becomes the discounted sum of its rewards,
            without the entropy bonus on the way, and γ becomes γ to that power.
        layer_norm: normalise each map's embedding, see `Encoder`.
        alpha_rate_factor: the learning rate of log α is so many times that of the weights.
    """

    METRICS = ("q_loss", "actor_loss", "alpha_loss", "alpha", "entropy", "q_mean", "td_error")

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
        n_steps: int = 1,
        layer_norm: bool = False,
        alpha_rate_factor: float = 1.0,
    ) -> None:
        if encoder not in ENCODERS:
            raise ValueError(f"encoder={encoder!r}: expected one of {', '.join(ENCODERS)}")
        device = torch.device(device)
        self.codecs = map_codecs(observation_spec, keys, compute_dtype(precision, device))
        actions = DiscreteActions.from_spec(action_spec)
        self.policy = self.build_policy(
            observation_spec,
            action_spec,
            keys,
            device=device,
            precision=precision,
            hidden_size=hidden_size,
            layer_norm=layer_norm,
        )
        actor = self.policy[0].module.network
        self.actor_encoder, actor_head = actor.encoder, actor.head
        with device:
            self.encoder_is_shared = encoder == "shared"
            self.critic_encoder = (
                self.actor_encoder
                if self.encoder_is_shared
                else Encoder(self.codecs, layer_norm=layer_norm)
            )
            critic_head = Head(self.critic_encoder.embedding_size, hidden_size, actions.count)
        self.target_encoder = copy.deepcopy(self.critic_encoder).requires_grad_(False)
        self.loss = DiscreteSACHeadsLoss(
            stochastic_policy(actor_head, ["actor_embedding"], actions),
            TensorDictModule(critic_head, ["critic_embedding"], ["action_value"]),
            action_space=actions.space,
            num_actions=actions.count,
            loss_function="l2",
            alpha_init=initial_alpha,
            target_entropy="auto",
            target_entropy_weight=target_entropy_weight,
        )
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.tau = tau
        SoftUpdate(self.loss, tau=tau)  # tells the loss that its targets are moved: below, at once
        heads = zip(
            self.loss.target_qvalue_network_params.values(True, True),
            self.loss.qvalue_network_params.values(True, True),
        )
        encoders = zip(self.target_encoder.parameters(), self.critic_encoder.parameters())
        self._targets = [(target, online.detach()) for target, online in [*heads, *encoders]]
        super().__init__(
            self._all_weights(),
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

    def _all_weights(self) -> dict[str, Tensor]:
        """Returns all that training changes: weights, target weights, log α."""
        encoders = {"critic_encoder": self.critic_encoder, "target_encoder": self.target_encoder}
        if not self.encoder_is_shared:
            encoders["actor_encoder"] = self.actor_encoder
        buffers = self.loss.named_buffers()
        targets = {name: weight for name, weight in buffers if name.startswith("target_qvalue")}
        return named_weights(**encoders) | dict(self.loss.named_parameters()) | targets

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
        """Returns the batch with maps replaced by embeddings.

        A shared encoder reads the maps of `s` and its target those of `s'`, for policy and
        Q-functions; separate ones read them for each.
        """
        images = decode_maps(self.codecs, batch)
        critic = self.critic_encoder(images)
        actor = critic.detach() if self.encoder_is_shared else self.actor_encoder(images)
        with torch.no_grad():
            images = decode_maps(self.codecs, batch["next"])
            following = batch["next"].select("reward", "done", "terminated")
            target = self.target_encoder(images)
            following["critic_embedding"] = target
            following["actor_embedding"] = (
                target if self.encoder_is_shared else self.actor_encoder(images)
            )
        return TensorDict(
            {
                "actor_embedding": actor,
                "critic_embedding": critic,
                "action": batch["action"],
                "steps_to_next_obs": batch["steps_to_next_obs"],
                "next": following,
            },
            batch.batch_size,
        )

    def after_update(self) -> None:
        """Moves the targets by `tau` of their distance."""
        targets, online = zip(*self._targets)
        move_targets(targets, online, self.tau)
