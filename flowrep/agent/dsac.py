"""Discrete soft actor-critic from maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from tensordict import NestedKey
from torchrl.data import Composite, TensorSpec
from torchrl.objectives import LossModule

from flowrep.agent.dsac_loss import DiscreteSACMapLoss
from flowrep.agent.off_policy import OffPolicy


class DiscreteSAC(OffPolicy):
    """Actor, two Q-functions and their targets, trained by discrete soft actor-critic.

    One gradient step minimises, over a batch and with π, Q1, Q2 from the embeddings of `s` and `s'`
    (the paper's Eqs. 2-5 without its state-value network):

        y   = r + γ (1 - terminated) Σ_a π(a|s') [min_i Q̄_i(s', a) - α log π(a|s')]
        L_Q = mean (Q1(s, a) - y)² + mean (Q2(s, a) - y)²
        L_π = mean Σ_a π(a|s) [α log π(a|s) - min_i Q_i(s, a)]
        L_α = mean -log α (Σ_a π(a|s) log π(a|s) + H̄),   H̄ = target_entropy_weight · log n

    All gradients are taken at the same weights, then Adam steps once, then the targets move by
    `tau`. ML-Agents halves L_Q (which changes Adam's steps only through its epsilon) and uses Q1
    alone in L_π. For transitions of several steps, r is the discounted sum of their rewards,
    without the entropy bonus of the steps between.

    Args:
        observation_spec: see `OffPolicy`, as for the next two arguments.
        action_spec: `Categorical` or `OneHot`.
        keys: the observation maps to read, in order.
        alpha_rate_factor: learning rate of log α relative to that of the weights.
        options: further arguments of `OffPolicy` and `DiscreteSACMapLoss`.
    """

    LOSS: ClassVar[Callable[..., LossModule]] = DiscreteSACMapLoss
    METRICS: ClassVar[Mapping[str, str]] = {
        "q_loss": "loss_qvalue",
        "actor_loss": "loss_actor",
        "alpha_loss": "loss_alpha",
        "alpha": "alpha",
        "entropy": "entropy",
        "q_mean": "q_mean",
        "td_error": "td_error",
    }

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        *,
        alpha_rate_factor: float = 1.0,
        **options: Any,
    ) -> None:
        rate_factors = {"log_alpha": alpha_rate_factor}
        super().__init__(observation_spec, action_spec, keys, rate_factors=rate_factors, **options)
