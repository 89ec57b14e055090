"""Options of algorithms and of what they see: each with its type, its range and its meaning.

An algorithm takes the object as it is, and `flowrep.config.schema` puts it into the commands'
configs. Nothing here imports PyTorch, so that a command can refuse a config at once.

>>> DiscreteSACOptions(gamma=0.97).tau
0.005
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

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
    """Named values: unknown names are refused, types are strict, and nothing can be set later."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    def plain(self) -> dict[str, Any]:
        """Returns names and values as they are written in a config."""
        return self.model_dump(by_alias=True)


# Algorithms, with the paper's Table II as defaults.


class AlgorithmOptions(Options):
    """What a config says about any algorithm."""

    target: str = Field("", alias="_target_", pattern=CLASS)

    def first_update(self, num_envs: int) -> tuple[str, int]:
        """Returns the option that delays learning, and the frames before the first update."""
        return "", 0


class LearnerOptions(AlgorithmOptions):
    """Options that flowrep's algorithms have in common."""

    precision: Literal["auto", "bf16", "fp32"] = "auto"  # of activations; weights are float32
    learning_rate: Positive = 3e-4  # Adam's, falls linearly to 0 at the end of the training
    gamma: Share = 0.99  # discount a frame
    hidden_size: Count = 512  # of the single hidden layer after the embeddings
    batch_size: Count = 1024  # steps an update


class OffPolicyOptions(LearnerOptions):
    """Options of algorithms with a replay memory.

    A transition spans `n_steps` frames: r is the discounted sum of their rewards, and γ becomes γⁿ.
    """

    tau: PositiveShare = 0.005  # share of the online weights in each move of the target weights
    replay_capacity: Count = 10_240  # frames
    frames_per_update: Count = 10  # of all environments
    learning_starts: Count | None = None  # frames before the first update; None: one batch
    n_steps: Count = 1
    layer_norm: bool = False  # of each map's embedding, see `flowrep.agent.networks.Encoder`
    mirror: bool = False  # half of each batch is replaced by its left-right images

    def first_update(self, num_envs: int) -> tuple[str, int]:
        """Returns the frames until the memory holds enough for an update."""
        key = "batch_size" if self.learning_starts is None else "learning_starts"
        starts = getattr(self, key)
        if starts < num_envs:
            raise ValueError(
                f"algorithm.{key}={starts} is less than num_envs={num_envs}: before their second "
                "step there is nothing to learn from; raise learning_starts, or lower num_envs"
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

    With a shared encoder, policy and Q-functions read one set of encoders, trained by L_Q alone. In
    y both read its target, so that each observation is encoded once. Separate encoders are one set
    each, and π(·|s') in y reads the policy's.
    """

    encoder: Literal["shared", "separate"] = "shared"


class DoubleDQNOptions(OffPolicyOptions):
    """Options of `algorithm=dqn`."""

    initial_epsilon: Share = 1.0  # probability ε of a random action, falls linearly
    final_epsilon: Share = 0.05  # ε after `exploration_share` of the frames
    exploration_share: Share = 0.2


class PPOOptions(LearnerOptions):
    """Options of `algorithm=ppo`."""

    batch_size: Count = 256  # steps an update; an incomplete last batch is left out of its pass
    rollout_length: Count = 64  # steps of each environment between two rounds of learning
    epochs: Count = 4  # passes over them
    gae_lambda: Share = 0.95  # GAE's λ, from 0 (relies on V) to 1 (relies on the rewards)
    clip: PositiveShare = 0.2  # ρ farther than this from 1 brings no more
    value_weight: NotNegative = 0.5  # of L_V
    entropy_weight: NotNegative = 0.01  # of L_H
    max_grad_norm: Positive = 0.5  # of all gradients together, which are scaled down to it

    def first_update(self, num_envs: int) -> tuple[str, int]:
        """Returns the frames of a rollout."""
        return "rollout_length", self.rollout_length * num_envs


ALGORITHMS: dict[str, type[AlgorithmOptions]] = {
    f"flowrep.agent.{options.__name__.removesuffix('Options')}": options
    for options in (DiscreteSACOptions, DiscreteSACWithValueOptions, DoubleDQNOptions, PPOOptions)
}
"""The options of flowrep's algorithms, by `_target_`."""


# What an agent sees. The transforms' constructors hold the defaults, and check ranges again: they
# need neither pydantic nor a config, and importing them takes 3 s, where this takes 0.1 s.
# tests/test_configs.py holds both to the same defaults and ranges.


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
    """A transform of the user's own, with the arguments of its constructor."""

    model_config = ConfigDict(extra="allow")
    target: str = Field(alias="_target_", pattern=CLASS)


class Representations(Options):
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


class ExactFlow(Options):
    """`flow=exact`."""

    source: Literal["exact"] = "exact"


class EstimatedFlow(Options):
    """`flow=estimated`: options of `flowrep.transforms.EstimatedFlow`."""

    source: Literal["estimated"]
    estimator: Literal["dis", "raft_small", "raft_large"]
    weights: Text | None
    preset: Literal["ultrafast", "fast", "medium", "fine"]
    min_side_px: Count
    picture_scale: Count = 1


class Noise(Options):
    """Errors of the depth camera and of odometry: options of `flowrep.transforms.SensorNoise`."""

    depth_sigma_per_m: NotNegative = 0.0
    depth_dropout: Share = 0.0
    drift_m: NotNegative = 0.0
    drift_rad: NotNegative = 0.0
