"""Double deep Q-learning from maps, by TorchRL's loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torch.distributions import Distribution
from torchrl.data import Composite, TensorSpec
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss, SoftUpdate, ValueEstimators

from flowrep.agent.action import DiscreteActions
from flowrep.agent.observation import map_codecs
from flowrep.agent.off_policy import OffPolicy
from flowrep.agent.policy import PackedNetwork, PolicyNetwork, acting_network
from flowrep.agent.precision import compute_dtype


class EpsilonGreedyPolicy(TensorDictSequential):
    """Writes the action of the largest value, or, with probability ε, one drawn evenly."""

    def __init__(
        self,
        network: PolicyNetwork,
        keys: Sequence[NestedKey],
        actions: DiscreteActions,
        exploration: EGreedyModule,
    ) -> None:
        super().__init__(
            TensorDictModule(network, keys, ["action_value"]),
            QValueModule(action_space=actions.space),
            exploration,
        )
        self.distribution_class: Any = actions.distribution
        self.select_out_keys("action")

    def get_dist(self, tensordict: TensorDictBase) -> Distribution:
        """Returns the distribution that actions are drawn from, as other policies do."""
        acting, _, exploration = self
        values = acting(tensordict.copy())["action_value"]
        best = torch.nn.functional.one_hot(values.argmax(-1), values.shape[-1])
        epsilon = exploration.eps
        return self.distribution_class(probs=epsilon / values.shape[-1] + (1 - epsilon) * best)


class DoubleDQN(OffPolicy):
    """One Q-function and its target, acting at random with a probability ε that falls.

    One gradient step minimises, over a batch,

        L_Q = mean (Q(s, a) - r - γ (1 - terminated) Q̄(s', argmax_a Q(s', a)))²

    and moves the target by `tau`. Without exploration (TorchRL's `ExplorationType.DETERMINISTIC`)
    the policy takes the action of the largest value.

    Args:
        observation_spec: the environment's; its last three dims of each map are C, H, W.
        action_spec: `Categorical` or `OneHot`.
        keys: the observation maps to read, in order.
        total_frames: environment frames of the whole training; sets the learning rate's end.
        device: where networks, replay and updates live.
        precision: `"auto"`, `"bf16"` or `"fp32"`; weights are float32 in each case.
        learning_rate: Adam's, falling linearly to 0.
        initial_epsilon: ε at the start.
        final_epsilon: ε from `exploration_share` of the frames on; it falls linearly until there.
        exploration_share: of `total_frames`.
        gamma: discount a frame.
        tau: share of the online weights in each move of the target.
        hidden_size: width of the one hidden layer after the embeddings.
        batch_size: transitions an update.
        replay_capacity: transitions kept.
        frames_per_update: environment frames for each gradient step.
        learning_starts: frames before the first update; None: one batch.
        n_steps: frames that a transition spans: r becomes the discounted sum of its rewards, and γ
            becomes γ to that power.
        layer_norm: normalise each map's embedding, see `Encoder`.
    """

    METRICS = ("q_loss", "td_error", "epsilon")

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
        initial_epsilon: float,
        final_epsilon: float,
        exploration_share: float,
        gamma: float,
        tau: float,
        hidden_size: int,
        batch_size: int,
        replay_capacity: int,
        frames_per_update: int,
        learning_starts: int | None,
        n_steps: int = 1,
        layer_norm: bool = False,
    ) -> None:
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
            initial_epsilon=initial_epsilon,
            final_epsilon=final_epsilon,
            exploration_share=exploration_share,
            total_frames=total_frames,
        )
        acting, best, self.exploration = self.policy
        learning = TensorDictModule(
            PackedNetwork(self.codecs, acting.module.network), list(keys), ["action_value"]
        )
        self.loss = DQNLoss(
            TensorDictSequential(learning, best),
            loss_function="l2",
            delay_value=True,
            double_dqn=True,
            action_space=actions.space,
        )
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self._move_target = SoftUpdate(self.loss, tau=tau)
        buffers = self.loss.named_buffers()
        targets = {name: weight for name, weight in buffers if name.startswith("target_value")}
        super().__init__(
            dict(self.loss.named_parameters()) | targets | {"epsilon": self.exploration.eps},
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
        )

    @classmethod
    def build_policy(
        cls,
        observation_spec: Composite,
        action_spec: TensorSpec,
        keys: Sequence[NestedKey],
        *,
        device: torch.device | str,
        **options: Any,
    ) -> EpsilonGreedyPolicy:
        """Returns the acting side alone, see `Algorithm.build_policy`; ε lies in its state."""
        device = torch.device(device)
        network = acting_network(
            observation_spec,
            action_spec,
            keys,
            device=device,
            precision=options["precision"],
            hidden_size=options["hidden_size"],
            layer_norm=options["layer_norm"],
        )
        exploration = EGreedyModule(
            action_spec,
            float(options["initial_epsilon"]),
            float(options["final_epsilon"]),
            max(1, int(options["exploration_share"] * options["total_frames"])),
            device=device,
        )
        return EpsilonGreedyPolicy(
            network, list(keys), DiscreteActions.from_spec(action_spec), exploration
        )

    def remember(self, steps: TensorDictBase) -> None:
        """Takes in steps, and lowers ε for each."""
        super().remember(steps)
        e = self.exploration
        fall = (e.eps_init - e.eps_end) / e.annealing_num_steps * steps.numel()
        e.eps.copy_(torch.maximum(e.eps - fall, e.eps_end))

    def losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Returns the loss, with gradients, and what it was computed from, without."""
        q_loss = self.loss(batch)["loss"]
        squared_error = batch["td_error"]  # the loss leaves it there
        return {
            "q_loss": q_loss,
            "td_error": squared_error.sqrt().mean(),
            "epsilon": self.exploration.eps.clone(),
        }

    def after_update(self) -> None:
        """Moves the target by `tau` of its distance."""
        self._move_target.step()
