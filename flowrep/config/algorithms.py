"""Options of algorithms: their types, ranges and meanings, with the paper's Table II as defaults.

Nothing here imports PyTorch, so that commands can refuse a config fast.

>>> DiscreteSACOptions(gamma=0.97).tau
0.005
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from flowrep.config.options import (
    CLASS,
    Count,
    NotNegative,
    Options,
    Positive,
    PositiveShare,
    Share,
)


class AlgorithmOptions(Options):
    """Options of any algorithm."""

    target: str = Field("", alias="_target_", pattern=CLASS)

    def first_update(self, num_envs: int) -> tuple[str, int]:
        """Returns the option that delays learning, and the frames before the first update."""
        return "", 0


class LearnerOptions(AlgorithmOptions):
    """Options that flowrep's algorithms have in common."""

    precision: Literal["auto", "bf16", "fp32"] = "auto"  # of activations; weights are float32
    learning_rate: Positive = 3e-4  # Adam's, falls linearly to 0 at the end of the training
    gamma: Share = 0.99  # discount per frame
    hidden_size: Count = 512  # of the single hidden layer after the embeddings
    batch_size: Count = 1024  # transitions per update


class OffPolicyOptions(LearnerOptions):
    """Options of algorithms with a replay memory.

    A transition spans `n_steps` frames: r is the discounted sum of their rewards, and γ becomes γⁿ.
    """

    tau: PositiveShare = 0.005  # share of the online weights in each update of the target weights
    replay_capacity: Count = 10_240  # frames
    frames_per_update: Count = 10  # of all envs together
    learning_starts: Count | None = None  # frames before the first update; None: one batch
    n_steps: Count = 1
    layer_norm: bool = False  # of each map's embedding, see `flowrep.agent.networks.Encoder`
    mirror: bool = False  # replace half of each batch by its left-right images

    def first_update(self, num_envs: int) -> tuple[str, int]:
        """Returns the frames until the memory holds enough for an update."""
        key = "batch_size" if self.learning_starts is None else "learning_starts"
        starts = getattr(self, key)
        if starts < num_envs:
            raise ValueError(
                f"algorithm.{key}={starts} is less than num_envs={num_envs}, but there is nothing "
                "to learn from before the envs' second step; raise learning_starts, or lower "
                "num_envs"
            )
        least = (1 + self.n_steps) * num_envs  # a transition of all envs, and the step after it
        if self.replay_capacity < least:
            raise ValueError(
                f"algorithm.replay_capacity={self.replay_capacity} can't hold a transition of "
                f"num_envs={num_envs}: give at least {least}, or fewer envs"
            )
        return key, starts + self.frames_per_update


class SoftActorCriticOptions(OffPolicyOptions):
    """Options of algorithms that reward entropy."""

    initial_alpha: Positive = 0.5  # entropy coefficient α before the first update
    target_entropy_weight: Share = 0.2  # target entropy as a share of the largest, log n
    alpha_rate_factor: NotNegative = 1.0  # learning rate of log α over that of the weights


class DiscreteSACWithValueOptions(SoftActorCriticOptions):
    """Options of `algorithm=dsac_v`."""


class DiscreteSACOptions(SoftActorCriticOptions):
    """Options of `algorithm=dsac`.

    With a shared encoder, policy and Q-functions read one set of encoders, which only L_Q trains.
    For the target y, both read the target encoders, so that each observation is encoded once. With
    separate encoders, policy and Q-functions have a set each, and π(·|s') in y reads the policy's.
    """

    encoder: Literal["shared", "separate"] = "shared"


class DoubleDQNOptions(OffPolicyOptions):
    """Options of `algorithm=dqn`."""

    initial_epsilon: Share = 1.0  # probability ε of a random action, falls linearly
    final_epsilon: Share = 0.05  # ε after `exploration_share` of the frames
    exploration_share: Share = 0.2

    @model_validator(mode="after")
    def _epsilon_falls(self) -> DoubleDQNOptions:
        if self.initial_epsilon < self.final_epsilon:
            raise ValueError(
                f"initial_epsilon={self.initial_epsilon} is less than "
                f"final_epsilon={self.final_epsilon}, but ε only falls"
            )
        return self


class PPOOptions(LearnerOptions):
    """Options of `algorithm=ppo`."""

    batch_size: Count = 256  # steps per update; a pass leaves out an incomplete last batch
    rollout_length: Count = 64  # steps of each env between two rounds of updates
    epochs: Count = 4  # passes over these steps in a round
    gae_lambda: Share = 0.95  # GAE's λ, from 0 (relies on V) to 1 (relies on the rewards)
    clip: PositiveShare = 0.2  # moving ρ farther than this from 1 gains nothing
    value_weight: Positive = 0.5  # of L_V
    entropy_weight: NotNegative = 0.01  # of L_H
    max_grad_norm: Positive = 0.5  # of all gradients together, which are scaled down to it

    def first_update(self, num_envs: int) -> tuple[str, int]:
        """Returns the frames of a rollout."""
        frames = self.rollout_length * num_envs
        if self.batch_size > frames:
            raise ValueError(
                f"algorithm.batch_size={self.batch_size} is more than the {frames} frames of a "
                f"rollout ({self.rollout_length} steps of {num_envs} envs): raise rollout_length "
                "or num_envs, or lower batch_size"
            )
        return "rollout_length", frames


ALGORITHMS: dict[str, type[AlgorithmOptions]] = {
    f"flowrep.agent.{options.__name__.removesuffix('Options')}": options
    for options in (DiscreteSACOptions, DiscreteSACWithValueOptions, DoubleDQNOptions, PPOOptions)
}
"""The options of flowrep's algorithms, by `_target_`."""
