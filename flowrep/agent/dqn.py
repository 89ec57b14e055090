"""Double deep Q-learning from maps, with TorchRL's loss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torch.distributions import Categorical, Distribution
from torchrl.data import Composite, TensorSpec
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss, ValueEstimators

from flowrep.agent.algorithm import OffPolicy
from flowrep.agent.networks import MapNetwork, PolicyNetwork, action_count
from flowrep.config.algorithms import DoubleDQNOptions


class EpsilonGreedyPolicy(TensorDictSequential):
    """Writes the action with the largest value or, with probability ε, a uniformly random one."""

    def __init__(
        self, network: PolicyNetwork, keys: Sequence[NestedKey], exploration: EGreedyModule
    ) -> None:
        super().__init__(
            TensorDictModule(network, keys, ["action_value"]),
            QValueModule(action_space="categorical"),
            exploration,
        )
        self.select_out_keys("action")

    def get_dist(self, tensordict: TensorDictBase) -> Distribution:
        """Returns the distribution from which actions are drawn, like other policies."""
        values = self[0](tensordict.copy())["action_value"]
        best = F.one_hot(values.argmax(-1), values.shape[-1])
        epsilon = self[2].eps
        return Categorical(probs=epsilon / values.shape[-1] + (1 - epsilon) * best)


class DoubleDQNMapLoss(DQNLoss):
    """TorchRL's double Q-learning loss on stored maps, with a target; see `DoubleDQN`."""

    def __init__(self, network: MapNetwork, num_actions: int, options: DoubleDQNOptions) -> None:
        keys = [codec.key for codec in network.codecs]
        learning = TensorDictModule(PolicyNetwork(network), keys, ["action_value"])
        super().__init__(
            TensorDictSequential(learning, QValueModule(action_space="categorical")),
            loss_function="l2",
            delay_value=True,
            double_dqn=True,
            action_space="categorical",
        )
        self.make_value_estimator(ValueEstimators.TD0, gamma=options.gamma)


class DoubleDQN(OffPolicy):
    """One Q-function and its target; acts at random with a falling probability ε.

    One update minimises, over a batch,

        L_Q = mean (Q(s, a) - r - γ (1 - terminated) Q̄(s', argmax_a Q(s', a)))²

    and moves the target by `tau`. Without exploration (TorchRL's `ExplorationType.DETERMINISTIC`)
    the policy takes the action with the largest value.
    """

    OPTIONS = DoubleDQNOptions
    LOSS = DoubleDQNMapLoss
    METRICS: ClassVar = {"q_loss": "loss", "td_error": "td_error", "epsilon": "epsilon"}

    @property
    def exploration(self) -> EGreedyModule:
        """The policy's module that holds ε."""
        return self.policy[2]

    def other_weights(self) -> Mapping[str, Tensor]:
        """Returns ε."""
        return {"epsilon": self.exploration.eps}

    @classmethod
    def make_policy(
        cls,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        options: DoubleDQNOptions,
        *,
        total_frames: int,
        device: torch.device | str = "cpu",
    ) -> EpsilonGreedyPolicy:
        """See `Algorithm.make_policy`; the policy's state includes ε."""
        run: Any = {"total_frames": total_frames, "device": device}
        stochastic = super().make_policy(observation_spec, action_spec, keys, options, **run)
        exploration = EGreedyModule(
            # Without the batch of envs, so that any batch may act.
            type(action_spec)(action_count(action_spec), dtype=action_spec.dtype, device=device),
            options.initial_epsilon,
            options.final_epsilon,
            max(1, int(options.exploration_share * total_frames)),
            device=device,
        )
        return EpsilonGreedyPolicy(stochastic[0].module, list(keys), exploration)

    def remember(self, steps: TensorDictBase) -> None:
        """Stores steps and lowers ε for each of them."""
        super().remember(steps)
        # EGreedyModule.step would loop over the frames.
        e = self.exploration
        fall = (e.eps_init - e.eps_end) / e.annealing_num_steps * steps.numel()
        e.eps.copy_(torch.maximum(e.eps - fall, e.eps_end))

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Returns the loss, with gradients, and the TD error and ε, without."""
        out = self.loss(batch)
        td_error = batch["td_error"].sqrt().mean()  # the loss stores its square
        epsilon = self.exploration.eps.clone()
        return {"q_loss": out["loss"], "td_error": td_error, "epsilon": epsilon}
