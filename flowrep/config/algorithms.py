"""The section `algorithm`: the options of each class that `_target_` may name."""

from typing import Annotated, Protocol

from pydantic import ConfigDict, Field

from flowrep.agent.dsac import ENCODERS
from flowrep.agent.observation import PRECISIONS
from flowrep.config.expectations import (
    Count,
    NotNegative,
    Number,
    OneOf,
    Positive,
    PositiveShare,
    Share,
    Switch,
    Text,
    Whole,
)
from flowrep.config.section import ChosenBy, Section
from flowrep.config.violations import broken_rule


class Run(Protocol):
    """The parts of a run that rules for its algorithm depend on."""

    total_frames: int
    num_envs: int


class AnyAlgorithm(Section):
    """The key that every algorithm has: its class."""

    target: Annotated[str, Text("the name of a class, package.module.Class")] = Field(
        alias="_target_", examples=["flowrep.agent.DiscreteSAC"]
    )

    def check_with(self, run: Run) -> None:
        """Checks an algorithm's options against the rest of the run.

        Raises:
            PydanticCustomError: from `broken_rule`, naming the key from the top level on.
        """


class OwnAlgorithm(AnyAlgorithm):
    """A user's own class, whose options are those of its signature."""

    model_config = ConfigDict(extra="allow")


class Learner(AnyAlgorithm):
    """The options that the algorithms of `flowrep.agent` have in common."""

    precision: Annotated[str, OneOf(PRECISIONS)]
    learning_rate: Positive
    gamma: Share
    hidden_size: Count
    batch_size: Count


class OffPolicy(Learner):
    """The options that algorithms with a replay memory have in common."""

    tau: PositiveShare
    replay_capacity: Count
    frames_per_update: Count
    learning_starts: Annotated[int | None, Whole(1, also=(None,))]
    n_steps: Count
    layer_norm: Switch

    def check_with(self, run: Run) -> None:
        """Checks that the memory is large enough, and that the run is long enough to learn."""
        steps = self.n_steps + 1
        for name, least in (
            (f"batch_size={self.batch_size}", self.batch_size),
            (f"{steps} steps of num_envs={run.num_envs}", steps * run.num_envs),
        ):
            if self.replay_capacity < least:
                raise broken_rule(
                    "algorithm.replay_capacity",
                    f"should hold at least {name}, {least} transitions, not "
                    f"{self.replay_capacity}; raise it or lower the other",
                )
        key, starts = "learning_starts", self.learning_starts
        if starts is None:
            key, starts = "batch_size", self.batch_size
        if starts < run.num_envs:
            raise broken_rule(
                f"algorithm.{key}",
                f"should be at least num_envs={run.num_envs}, not {starts}: before their second "
                "step there is nothing to learn from; raise learning_starts or lower num_envs",
            )
        first = starts + self.frames_per_update
        if first > run.total_frames:
            raise broken_rule(
                f"algorithm.{key}",
                f"is {starts}, so the first update would come after {first} frames, but "
                f"total_frames is {run.total_frames}: nothing would be learnt",
            )


class DiscreteSAC(OffPolicy):
    """`algorithm=dsac`."""

    encoder: Annotated[str, OneOf(ENCODERS)]
    initial_alpha: Positive
    target_entropy_weight: Share
    alpha_rate_factor: NotNegative


class DiscreteSACWithValue(OffPolicy):
    """`algorithm=dsac_v`."""

    initial_alpha: Positive
    target_entropy_weight: Share
    alpha_rate_factor: NotNegative


class DoubleDQN(OffPolicy):
    """`algorithm=dqn`."""

    initial_epsilon: Share
    final_epsilon: Share
    exploration_share: Share

    def check_with(self, run: Run) -> None:
        """Checks that exploration falls."""
        if self.final_epsilon > self.initial_epsilon:
            raise broken_rule(
                "algorithm.final_epsilon",
                f"should be at most initial_epsilon={self.initial_epsilon}, "
                f"not {self.final_epsilon}",
            )
        super().check_with(run)


class PPO(Learner):
    """`algorithm=ppo`."""

    rollout_length: Count
    epochs: Count
    gae_lambda: Share
    clip: Annotated[float, Number(above=0, most=1)]
    value_weight: NotNegative
    entropy_weight: NotNegative
    max_grad_norm: Positive

    def check_with(self, run: Run) -> None:
        """Checks that a rollout fills a batch, and that the run is long enough for one."""
        rollout = self.rollout_length * run.num_envs
        steps = (
            f"{rollout} frames of a rollout ({self.rollout_length} steps of {run.num_envs} envs)"
        )
        if self.batch_size > rollout:
            raise broken_rule(
                "algorithm.batch_size",
                f"should be at most the {steps}, not {self.batch_size}: "
                "lower it, or raise rollout_length or num_envs",
            )
        if rollout > run.total_frames:
            raise broken_rule(
                "algorithm.rollout_length",
                f"makes the {steps}, but total_frames is {run.total_frames}: "
                "nothing would be learnt",
            )


ALGORITHMS: dict[str, type[AnyAlgorithm]] = {
    f"flowrep.agent.{section.__name__}": section
    for section in (DiscreteSAC, DiscreteSACWithValue, DoubleDQN, PPO)
}
"""The sections of flowrep's own algorithms, by `_target_`."""

BY_TARGET = ChosenBy("_target_", ALGORITHMS, otherwise=OwnAlgorithm)
