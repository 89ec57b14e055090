"""Discrete soft actor-critic with a state-value network: Eqs. 2-5 as in the paper's trainer."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams
from torchrl.objectives import LossModule

from flowrep.agent.algorithm import td_target, transition_keys
from flowrep.agent.dsac import DiscreteSAC
from flowrep.agent.map_codec import decode_maps
from flowrep.agent.networks import MapNetwork
from flowrep.config.algorithms import DiscreteSACWithValueOptions

METRICS = {
    "q_loss": "loss_qvalue", "value_loss": "loss_value", "actor_loss": "loss_actor",
    "alpha_loss": "loss_alpha", "alpha": "alpha", "entropy": "entropy", "q_mean": "q_mean",
    "value_mean": "value_mean",
}  # fmt: skip


class DiscreteSACValueLoss(LossModule):
    """The losses of `DiscreteSACWithValue` on stored maps, as `ReplayMemory` samples them.

    Its target parameters are those of V.
    """

    actor: MapNetwork
    actor_params: TensorDictParams
    target_actor_params: TensorDictParams
    q1: MapNetwork
    q1_params: TensorDictParams
    target_q1_params: TensorDictParams
    q2: MapNetwork
    q2_params: TensorDictParams
    target_q2_params: TensorDictParams
    value: MapNetwork
    value_params: TensorDictParams
    target_value_params: TensorDictParams
    out_keys: ClassVar[list[str]] = [*METRICS.values()]

    def __init__(
        self, actor: MapNetwork, num_actions: int, options: DiscreteSACWithValueOptions
    ) -> None:
        super().__init__()
        with next(actor.parameters()).device:
            q1, q2 = (actor.another(num_actions) for _ in range(2))
            value = actor.another(1)
            log_alpha = torch.nn.Parameter(torch.tensor(math.log(options.initial_alpha)))
        for name, network in {"actor": actor, "q1": q1, "q2": q2}.items():
            self.convert_to_functional(network, name)
        self.convert_to_functional(value, "value", create_target_params=True)
        self.log_alpha = log_alpha
        self.codecs, self.gamma = actor.codecs, options.gamma
        self.target_entropy = options.target_entropy_weight * math.log(num_actions)
        self.in_keys = transition_keys(self.codecs)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the losses of a batch, with gradients, and further metrics, without."""
        images = decode_maps(self.codecs, tensordict)
        action = tensordict["action"]
        alpha = self.log_alpha.detach().exp()

        log_policy = self.actor(images).log_softmax(-1)
        policy = log_policy.exp()
        negative_entropy = (policy * log_policy).sum(-1)
        q1, q2 = self.q1(images), self.q2(images)
        value = self.value(images).squeeze(-1)
        with torch.no_grad():
            with self.target_value_params.to_module(self.value):
                following = self.value(decode_maps(self.codecs, tensordict["next"]))
            y = td_target(tensordict, following, self.gamma)
            expected_q = torch.minimum((policy * q1).sum(-1), (policy * q2).sum(-1))
            value_target = expected_q - alpha * negative_entropy
        chosen = (q.gather(-1, action.unsqueeze(-1)).squeeze(-1) for q in (q1, q2))
        return TensorDict(
            {
                "loss_qvalue": 0.5 * sum(F.mse_loss(q, y) for q in chosen),
                "loss_value": 0.5 * F.mse_loss(value, value_target),
                # Q1 alone, as in ML-Agents.
                "loss_actor": (policy * (alpha * log_policy - q1.detach())).sum(-1).mean(),
                "loss_alpha": -self.log_alpha
                * (negative_entropy.detach() + self.target_entropy).mean(),
                "alpha": alpha,
                "entropy": -negative_entropy.mean(),
                "q_mean": expected_q.mean(),
                "value_mean": value.mean(),
            }
        )


class DiscreteSACWithValue(DiscreteSAC):
    """Actor, two Q-functions, a state-value function V and its target V̄, sharing no weights.

    One update minimises, over a batch and with Q_i(s, π) = Σ_a π(a|s) Q_i(s, a):

        y   = r + γ (1 - terminated) V̄(s')
        L_Q = ½ mean (Q1(s, a) - y)² + ½ mean (Q2(s, a) - y)²
        L_V = ½ mean (V(s) - min(Q1(s, π), Q2(s, π)) + α Σ_a π(a|s) log π(a|s))²
        L_π = mean Σ_a π(a|s) [α log π(a|s) - Q1(s, a)]
        L_α = mean -log α (Σ_a π(a|s) log π(a|s) + H̄),   H̄ = target_entropy_weight · log n

    Each loss trains only its own network; everything else is as in `DiscreteSAC`. This is what the
    paper's trainer, ML-Agents, computes. It needs five sets of encoders, against two for
    `DiscreteSAC` with a shared encoder.
    """

    OPTIONS = DiscreteSACWithValueOptions
    LOSS = DiscreteSACValueLoss
    METRICS = METRICS
