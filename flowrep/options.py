"""Options of algorithms, representations, flow and noise: their types, ranges and meanings.

Each class is a section of the commands' configs in `flowrep.config.schema`; an algorithm takes its
options as such an object. Nothing here imports PyTorch, so that commands can refuse a config fast.

>>> DiscreteSACOptions(gamma=0.97).tau
0.005
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

# Larger whole numbers are not exact as floats.
Count = Annotated[int, Field(ge=1, le=2**53)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
PositiveShare = Annotated[float, Field(gt=0, le=1)]
Text = Annotated[str, Field(min_length=1)]


def _not_zero(value: float) -> float:
    if value == 0:
        raise ValueError("should be a number other than 0")
    return value


NotZero = Annotated[float, AfterValidator(_not_zero)]
CLASS = r"^\w+(\.\w+)+$"  # package.module.Class


class Options(BaseModel):
    """Named values: unknown names are refused, types are strict, and values can't be changed."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    def plain(self) -> dict[str, Any]:
        """Returns names and values as in a config."""
        return self.model_dump(by_alias=True)


# Algorithms, with the paper's Table II as defaults.


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


# Representations, flow and noise. The transforms' constructors hold the defaults and check ranges
# again, as they work without pydantic; importing them takes 3 s, importing this module 0.1 s.
# tests/test_configs.py checks that both have the same defaults and ranges.


class SegmentationOptions(Options):
    """Options of `flowrep.transforms.Segmentation`."""

    encoding: Literal["ids", "onehot"]


class DepthOptions(Options):
    """Options of `flowrep.transforms.Depth`."""

    range_m: Positive
    missing: Share


class FlowOptions(Options):
    """Options of raw, ego and object flow."""

    scale: NotZero


class StackedSegmentationOptions(SegmentationOptions):
    """Options of seg2, the last k frames."""

    k: Count


class StackedDepthOptions(DepthOptions):
    """Options of depth2, the last k frames."""

    k: Count


class ForeignTransform(Options):
    """A user's transform, with the arguments of its constructor."""

    model_config = ConfigDict(extra="allow")
    target: str = Field(alias="_target_", pattern=CLASS)


class RepresentationOptions(Options):
    """The options of each representation, by name; another name is a `ForeignTransform`."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, ForeignTransform]
    rgb: Options | None = None
    seg: SegmentationOptions | None = None
    depth: DepthOptions | None = None
    raw: FlowOptions | None = None
    ego: FlowOptions | None = None
    obj: FlowOptions | None = None
    seg2: StackedSegmentationOptions | None = None
    depth2: StackedDepthOptions | None = None


class ExactFlowOptions(Options):
    """`flow=exact`."""

    source: Literal["exact"] = "exact"


class EstimatedFlowOptions(Options):
    """`flow=estimated`: options of `flowrep.transforms.EstimatedFlow`."""

    source: Literal["estimated"]
    estimator: Literal["dis", "raft_small", "raft_large"]
    weights: Text | None
    preset: Literal["ultrafast", "fast", "medium", "fine"]
    min_side_px: Count
    picture_scale: Count = 1

    @model_validator(mode="after")
    def _has_the_weights_it_needs(self) -> EstimatedFlowOptions:
        if self.estimator != "dis" and self.weights is None:
            raise ValueError(f"estimator={self.estimator} needs weights=, a file")
        if self.estimator == "dis" and self.weights is not None:
            raise ValueError("weights= is for RAFT; estimator=dis has none")
        return self


class NoiseOptions(Options):
    """Errors of the depth camera and of odometry: options of `flowrep.transforms.SensorNoise`."""

    depth_sigma_per_m: NotNegative = 0.0
    depth_dropout: Share = 0.0
    drift_m: NotNegative = 0.0
    drift_rad: NotNegative = 0.0
