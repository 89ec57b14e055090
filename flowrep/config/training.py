"""The config of `flowrep.train`, as conf/train.yaml and its groups compose it."""

from collections.abc import Mapping
from typing import Annotated, Any, get_args

from pydantic import ConfigDict, Field, model_validator

from flowrep.baselines.baselines import BASELINES
from flowrep.config.algorithms import BY_TARGET, AnyAlgorithm
from flowrep.config.expectations import (
    Count,
    CountOrZero,
    ListOf,
    Number,
    OneOf,
    Seed,
    Switch,
    Text,
    Whole,
)
from flowrep.config.representations import BY_SOURCE, Noise, Representations
from flowrep.config.section import Section, validated
from flowrep.config.violations import UsageError, broken_rule
from flowrep.experiment.run import MODES as WANDB_MODES
from flowrep.scenes.scene import FRAME_RATES_HZ, SpeedMode
from flowrep.simulator.camera import RENDERERS

SPEEDS: tuple[str, ...] = get_args(SpeedMode)
FRAME_RATE = Number(least=FRAME_RATES_HZ[0], most=FRAME_RATES_HZ[1])

Speed = Annotated[str, OneOf(SPEEDS)]
Device = Annotated[str, Text("auto, cpu, cuda or cuda:<number>", r"^(auto|cpu|cuda(:\d+)?)$")]
Workers = Annotated[int | str, Whole(0, also=("auto",))]
Trust = Annotated[str | None, Text("a class, package.module.Class", also=(None,))]
Path = Annotated[str | None, Text("a folder", also=(None,))]


class Evaluation(Section):
    """How the agent is evaluated while it learns and at the end."""

    every_frames: CountOrZero
    episodes: Count
    final_episodes: Count
    speeds: Annotated[list[str], ListOf(OneOf(SPEEDS))]
    fps: Annotated[list[float], ListOf(FRAME_RATE)]
    baselines: Annotated[list[str], ListOf(OneOf(tuple(BASELINES)), least=0)]
    video: Switch


class SceneSection(Section):
    """A scene; `flowrep.envs.load_scene` checks its content."""

    model_config = ConfigDict(extra="allow")


class TrainConfig(Section):
    """The whole config of a training."""

    seed: Seed = Field(examples=[0])
    device: Device
    speed: Speed
    total_frames: Count
    num_envs: Count
    num_workers: Workers
    compiled: Switch
    renderer: Annotated[str, OneOf(RENDERERS)]
    log_every_frames: Count
    checkpoint_every_frames: Count
    wandb: Annotated[str, OneOf(WANDB_MODES)]
    resume: Path
    trust: Trust
    experiment: Annotated[str | None, Text("an experiment's name", also=(None,))]
    evaluation: Evaluation
    representations: Representations = Field(examples=["[ego,obj]"])
    flow: Annotated[Any, BY_SOURCE] = Field(examples=["exact"])
    noise: Noise = Field(examples=["none"])
    scene: SceneSection = Field(examples=["straight_road"])
    algorithm: Annotated[AnyAlgorithm, BY_TARGET] = Field(examples=["dsac"])

    @model_validator(mode="after")
    def _fits_together(self) -> "TrainConfig":
        check_workers(self.num_workers, self.num_envs)
        self.algorithm.check_with(self)
        return self


def validated_run(config: Any, source: str) -> dict[str, Any]:
    """Returns the config of a run folder after checking it.

    Args:
        config: the config as read from the folder.
        source: the file, for messages.

    Raises:
        UsageError: it is not a run's config; has a line for each invalid key.
    """
    own_keys = config.keys() - TrainConfig.keys() if isinstance(config, Mapping) else ()
    try:
        validated(TrainConfig, config, own_keys)
    except UsageError as error:
        lines = str(error).splitlines()
        raise UsageError("\n".join(f"{source}: {line}" for line in lines)) from None
    return config


def check_workers(num_workers: int | str, num_envs: int) -> None:
    """Checks that each process has an environment to step.

    Raises:
        PydanticCustomError: from `broken_rule`.
    """
    if isinstance(num_workers, int) and num_workers > num_envs:
        raise broken_rule(
            "num_workers", f"should be at most num_envs={num_envs}, or auto, not {num_workers}"
        )
