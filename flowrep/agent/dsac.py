"""Discrete soft actor-critic, which encodes each map once for the policy and both Q-functions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor
from torchrl.objectives import DiscreteSACLoss, LossModule

from flowrep.agent import networks
from flowrep.agent.algorithm import OffPolicy, td_target, transition_keys
from flowrep.agent.map_codec import decode_maps
from flowrep.agent.networks import Encoder, Head, MapNetwork
from flowrep.config.algorithms import AlgorithmOptions, DiscreteSACOptions, SoftActorCriticOptions

METRICS = {
    "q_loss": "loss_qvalue", "actor_loss": "loss_actor", "alpha_loss": "loss_alpha",
    "alpha": "alpha", "entropy": "entropy", "q_mean": "q_mean", "td_error": "td_error",
}  # fmt: skip


class DiscreteSACMapLoss(DiscreteSACLoss):
    """Discrete SAC loss on stored maps, as `ReplayMemory` samples them; see `DiscreteSAC`.

    TorchRL's loss evaluates Q1 and Q2 one after the other (or by vmap), and twice at `s`: for L_Q
    with gradients, for L_π without. Here both share one hidden layer of twice the width and are
    evaluated once. TorchRL keeps the networks, the targets and α. Its target parameters are those
    of the Q-functions and their encoder.
    """

    critic_encoder: Encoder
    critic_encoder_params: TensorDictParams
    target_critic_encoder_params: TensorDictParams
    actor_encoder: Encoder
    actor_encoder_params: TensorDictParams
    target_actor_encoder_params: TensorDictParams
    out_keys: ClassVar[list[str]] = [*METRICS.values()]

    def __init__(self, actor: MapNetwork, num_actions: int, options: DiscreteSACOptions) -> None:
        shared = options.encoder == "shared"
        with next(actor.parameters()).device:
            critic_encoder = actor.encoder
            if not shared:
                critic_encoder = Encoder(actor.codecs, layer_norm=actor.encoder.layer_norm)
            critic_head = Head(critic_encoder.embedding_size, actor.hidden_size, num_actions)
        super().__init__(
            networks.stochastic_policy(actor.head, ["actor_embedding"]),
            TensorDictModule(critic_head, ["critic_embedding"], ["action_value"]),
            action_space="categorical",
            num_actions=num_actions,
            loss_function="l2",
            alpha_init=options.initial_alpha,
            target_entropy="auto",
            target_entropy_weight=options.target_entropy_weight,
        )
        self.codecs, self.gamma = actor.codecs, options.gamma
        self.encoder_is_shared = shared
        self.convert_to_functional(critic_encoder, "critic_encoder", create_target_params=True)
        if not shared:
            self.convert_to_functional(actor.encoder, "actor_encoder")

    def _set_in_keys(self) -> None:
        self._in_keys = transition_keys(self.codecs)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the losses of a batch, with gradients, and further metrics, without."""
        alpha = self.log_alpha.detach().exp()  # only L_α trains α
        # Before the other maps are decoded, because one-hot maps are large.
        target = self._target(tensordict, alpha)
        images = decode_maps(self.codecs, tensordict)
        embedding = self.critic_encoder(images)
        # L_π must not train the critic's encoder, neither directly nor through Q.
        seen = embedding.detach() if self.encoder_is_shared else self.actor_encoder(images)
        log_policy = self._log_policy(seen)
        policy = log_policy.exp()
        negative_entropy = (policy * log_policy).sum(-1)
        q = networks.heads_together(embedding, self.qvalue_network_params["module"])  # [2, N, n]
        chosen = q.gather(-1, tensordict["action"].expand(2, -1).unsqueeze(-1)).squeeze(-1)
        td_error = chosen - target
        # The smaller Q, because a policy that maximises a single Q exploits its errors.
        expected_q = (policy * q.detach().amin(0)).sum(-1)
        # H̄ - H: if the policy's entropy is too low, L_α raises α.
        lack = (negative_entropy.detach() + self.target_entropy).mean()
        return TensorDict(
            {
                "loss_qvalue": td_error.square().mean(-1).sum(),
                "loss_actor": (alpha * negative_entropy - expected_q).mean(),
                "loss_alpha": -self.log_alpha * lack,
                "alpha": alpha,
                "entropy": -negative_entropy.detach().mean(),
                "q_mean": expected_q.detach().mean(),
                "td_error": td_error.detach().abs().amax(0).mean(),
            }
        )

    @torch.no_grad()
    def _target(self, batch: TensorDictBase, alpha: Tensor) -> Tensor:
        """Returns y `[N]`."""
        images = decode_maps(self.codecs, batch["next"])
        # The target encoder is the same module with other weights.
        with self.target_critic_encoder_params.to_module(self.critic_encoder):
            embedding = self.critic_encoder(images)
        seen = embedding if self.encoder_is_shared else self.actor_encoder(images)
        log_policy = self._log_policy(seen)
        q = networks.heads_together(embedding, self.target_qvalue_network_params["module"]).amin(0)
        value = (log_policy.exp() * (q - alpha * log_policy)).sum(-1, keepdim=True)
        return td_target(batch, value, self.gamma)

    def _log_policy(self, embedding: Tensor) -> Tensor:
        """Returns log π `[N, n]`."""
        return self.actor_network[0].module(embedding).log_softmax(-1)


class DiscreteSAC(OffPolicy):
    """Actor, two Q-functions and their targets, trained by discrete soft actor-critic.

    π, Q1 and Q2 are computed from the embeddings of `s` and `s'`. One update minimises, over a
    batch (the paper's Eqs. 2-5 without its state-value network):

        y   = r + γ (1 - terminated) Σ_a π(a|s') [min_i Q̄_i(s', a) - α log π(a|s')]
        L_Q = mean (Q1(s, a) - y)² + mean (Q2(s, a) - y)²
        L_π = mean Σ_a π(a|s) [α log π(a|s) - min_i Q_i(s, a)]
        L_α = mean -log α (Σ_a π(a|s) log π(a|s) + H̄),   H̄ = target_entropy_weight · log n

    All gradients are taken at the same weights, then Adam steps once, then the targets move by
    `tau`. ML-Agents halves L_Q (which changes Adam's steps only through its epsilon) and uses only
    Q1 in L_π. For transitions of several steps, r is the discounted sum of their rewards, without
    the entropy bonus of the steps in between.
    """

    OPTIONS: ClassVar[type[AlgorithmOptions]] = DiscreteSACOptions
    options: SoftActorCriticOptions
    LOSS: ClassVar[Callable[..., LossModule]] = DiscreteSACMapLoss
    METRICS = METRICS

    def rate_factors(self) -> Mapping[str, float]:
        """Returns the factor of log α."""
        return {"log_alpha": self.options.alpha_rate_factor}
