"""TorchRL's discrete SAC loss on packed maps, which encodes each map once for both Q-functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor
from torchrl.objectives import DiscreteSACLoss, ValueEstimators

from flowrep.agent.action import DiscreteActions
from flowrep.agent.encoder import Encoder
from flowrep.agent.heads import Head, heads_together
from flowrep.agent.observation import MapCodec, decode_maps
from flowrep.agent.policy import MapNetwork, stochastic_policy

ENCODERS = ("shared", "separate")


class DiscreteSACHeadsLoss(DiscreteSACLoss):
    """`DiscreteSACLoss` with one `Head` as policy and several as Q-functions.

    TorchRL evaluates Q1 and Q2 one after the other (or by vmap), and twice at `s`: for L_Q with
    gradients, for L_π without. Here both share one hidden layer of twice the width, and L_π reuses
    the values computed for L_Q, so `qvalue_loss` must be called before `actor_loss` on the same
    batch.
    """

    def _make_vmap(self) -> None:
        self._vmap_qnetworkN0 = self._action_values
        self._of_this_batch: Tensor | None = None

    def _action_values(self, maps: TensorDictBase, params: Any) -> TensorDictBase:
        """Returns a TensorDict with the action values `[nets, N, n]` of all Q-functions."""
        (key,) = self.qvalue_network.in_keys
        if params is self._cached_detached_qvalue_params and self._of_this_batch is not None:
            values, self._of_this_batch = self._of_this_batch, None
        else:
            values = heads_together(maps[key], params["module"])
            if params is self.qvalue_network_params:
                self._of_this_batch = values.detach()
        return TensorDict({self.tensor_keys.action_value: values}, values.shape[:2])


class DiscreteSACMapLoss(DiscreteSACHeadsLoss):
    """Discrete SAC loss on packed maps, as `ReplayMemory` samples them; see `DiscreteSAC`.

    Reads the maps, `action`, `steps_to_next_obs` and, under `next`, the maps, `reward`, `done` and
    `terminated`. Returns `loss_qvalue`, `loss_actor` and `loss_alpha`, to be minimised as a sum,
    with `alpha`, `entropy`, `q_mean` and `td_error`. Its target parameters are those of the
    Q-functions and their encoder, and TorchRL's `SoftUpdate` moves all of them.

    Args:
        actor: the policy's network.
        actions: the policy's action space.
        encoder: with `"shared"`, policy and Q-functions read one set of encoders, trained by L_Q
            alone, and in y both read its target, so that each observation is encoded once. With
            `"separate"`, each has its own, and π(·|s') in y reads the policy's.
        initial_alpha: α before the first update.
        target_entropy_weight: target entropy as a share of the largest, log n.
        gamma: discount per frame.
    """

    critic_encoder: Encoder
    critic_encoder_params: TensorDictParams
    target_critic_encoder_params: TensorDictParams
    actor_encoder: Encoder
    actor_encoder_params: TensorDictParams
    target_actor_encoder_params: TensorDictParams
    out_keys: ClassVar[list[str]] = [
        "loss_qvalue",
        "loss_actor",
        "loss_alpha",
        "alpha",
        "entropy",
        "q_mean",
        "td_error",
    ]

    def __init__(
        self,
        actor: MapNetwork,
        actions: DiscreteActions,
        *,
        encoder: str = "shared",
        initial_alpha: float = 0.5,
        target_entropy_weight: float = 0.2,
        gamma: float = 0.99,
    ) -> None:
        if encoder not in ENCODERS:
            raise ValueError(f"encoder={encoder!r}: expected one of {', '.join(ENCODERS)}")
        shared = encoder == "shared"
        with next(actor.parameters()).device:
            critic_encoder = actor.encoder if shared else actor.another_encoder()
            critic_head = Head(critic_encoder.embedding_size, actor.hidden_size, actions.count)
        super().__init__(
            stochastic_policy(actor.head, ["actor_embedding"], actions),
            TensorDictModule(critic_head, ["critic_embedding"], ["action_value"]),
            action_space=actions.space,
            num_actions=actions.count,
            loss_function="l2",
            alpha_init=initial_alpha,
            target_entropy="auto",
            target_entropy_weight=target_entropy_weight,
        )
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.codecs, self.encoder_is_shared = actor.codecs, shared
        self.convert_to_functional(critic_encoder, "critic_encoder", create_target_params=True)
        if not shared:
            self.convert_to_functional(actor.encoder, "actor_encoder")

    def _set_in_keys(self) -> None:
        self._in_keys = transition_keys(self.codecs)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the losses of a batch, with gradients, and further metrics, without."""
        embedded = self._embed(tensordict)
        loss_qvalue, critic_info = self.qvalue_loss(embedded)
        # the policy loss must not reach the critic's encoder through Q(s, a)
        embedded["critic_embedding"] = embedded["critic_embedding"].detach()
        loss_actor, actor_info = self.actor_loss(embedded)
        negative_entropy = actor_info["log_prob"]
        alpha = self.log_alpha.detach().exp()
        entropy = -negative_entropy.mean()
        return TensorDict(
            {
                "loss_qvalue": loss_qvalue,
                "loss_actor": loss_actor,
                "loss_alpha": self.alpha_loss(negative_entropy).mean(),
                "alpha": alpha,
                "entropy": entropy,
                # L_π = -α · entropy - mean Σ_a π min_i Q_i
                "q_mean": -(loss_actor.detach() + alpha * entropy),
                "td_error": critic_info["td_error"].mean(),
            }
        )

    def _embed(self, batch: TensorDictBase) -> TensorDict:
        """Returns the batch with its maps replaced by embeddings."""
        images = decode_maps(self.codecs, batch)
        critic = self.critic_encoder(images)
        actor = critic.detach() if self.encoder_is_shared else self.actor_encoder(images)
        with torch.no_grad():
            images = decode_maps(self.codecs, batch["next"])
            following = batch["next"].select("reward", "done", "terminated")
            with self.target_critic_encoder_params.to_module(self.critic_encoder):
                target = self.critic_encoder(images)
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


def transition_keys(codecs: Sequence[MapCodec]) -> list[NestedKey]:
    """Returns the keys of a sampled transition that a loss reads."""
    maps = [codec.key for codec in codecs]
    outcome = ["reward", "done", "terminated"]
    following: list[NestedKey] = [
        ("next", *(key if isinstance(key, tuple) else (key,))) for key in (*maps, *outcome)
    ]
    return [*maps, "action", "steps_to_next_obs", *following]
