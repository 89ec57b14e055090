"""The configs of the commands on agents as pydantic models: every key, its type and its range.

`conf/` holds the values. Options of maps, flow and noise are checked by the transforms that take
them, which `experiment.build` makes before a run has a folder.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    InstanceOf,
    PlainSerializer,
    Tag,
    model_validator,
)

from flowrep.config.algorithms import ALGORITHMS, AlgorithmOptions
from flowrep.config.options import (
    CLASS,
    FRAME_RATES_HZ,
    BaselineName,
    Command,
    Count,
    CountOrZero,
    Distinct,
    FlowOptions,
    OneOrMore,
    Options,
    SpeedMode,
    Text,
    validated,
)
from flowrep.config.usage import UsageError
from flowrep.scenes import Scene, load_scene
from flowrep.scenes.load import scene_data

Seed = Annotated[int, Field(ge=0, lt=2**31)]  # every library's generator takes these
FrameRate = Annotated[float, Field(ge=FRAME_RATES_HZ[0], le=FRAME_RATES_HZ[1])]
MotionChoice = Literal["exact", "estimated"]
Device = Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")]
Workers = CountOrZero | Literal["auto"]
Acting = Literal["greedy", "sampled"]
"""How an agent acts in its final evaluation."""
Actings = Annotated[list[Acting], Field(min_length=1), Distinct]
SpeedModes = Annotated[list[SpeedMode], Field(min_length=1), Distinct]
FrameRates = Annotated[list[FrameRate], Field(min_length=1), Distinct]
BaselineNames = Annotated[list[BaselineName], Distinct]


def _checked_names(maps: dict[str, Any]) -> dict[str, Any]:
    if not maps or not all(name.isidentifier() for name in maps):
        raise ValueError("choose at least one by its name: representations=[ego,obj]")
    return maps


def _scene(value: Any) -> Any:
    """Returns a section `scene` as the `Scene` that it describes."""
    if not isinstance(value, Mapping | Scene):  # a name would read a file
        raise ValueError(f"should be the keys of a scene, as in conf/scene, not {value!r:.60}")
    return load_scene(value)


MapOptions = Annotated[dict[str, dict[str, Any]], AfterValidator(_checked_names)]
# Written out in stored configs, as a scene's file may change or be somebody else's.
SceneSection = Annotated[InstanceOf[Scene], BeforeValidator(_scene), PlainSerializer(scene_data)]


class ForeignAlgorithm(AlgorithmOptions):
    """Options of a user's algorithm, which `experiment.build` checks."""

    model_config = ConfigDict(extra="allow")
    target: str = Field(alias="_target_", pattern=CLASS)


def _tag(section: Any) -> str:
    """Returns the tag of an algorithm's section in the union `Algorithm`."""
    # A class that is none of flowrep's checks its options itself, once it may be imported.
    plain = section.plain() if isinstance(section, AlgorithmOptions) else section
    target = plain.get("_target_") if isinstance(plain, Mapping) else None
    return target if isinstance(target, str) and target in ALGORITHMS else "a user's"


if TYPE_CHECKING:
    Algorithm = AlgorithmOptions
else:
    Algorithm = Annotated[
        Union[
            Annotated[ForeignAlgorithm, Tag("a user's")],
            *(Annotated[options, Tag(target)] for target, options in ALGORITHMS.items()),
        ],
        Discriminator(_tag),
    ]


class Trusted(Options):
    """A class outside of flowrep that a run's config may name."""

    target: Text | None = Field(alias="_target_")


class Machine(Options):
    """Where an agent from Python runs: arguments of `Agent.load`."""

    device: Device
    num_envs: Count | None
    num_workers: Workers


class EnvConfig(Command):
    """The keys from which an env is built."""

    seed: Seed
    device: Device
    speed: SpeedMode
    num_envs: Count
    num_workers: Workers
    representations: MapOptions
    flow: FlowOptions
    motion: MotionChoice
    noise: dict[str, Any]
    scene: SceneSection


class Evaluation(Options):
    """How the agent is evaluated while it learns and at the end."""

    every_frames: CountOrZero
    episodes: Count
    final_episodes: Count
    speeds: SpeedModes
    fps: FrameRates
    policies: Actings
    baselines: BaselineNames
    video: bool
    mirror: bool = False

    @property
    def final_total(self) -> int:
        """The number of episodes of the final evaluation."""
        policies = len(self.policies) + len(self.baselines)
        return len(self.speeds) * len(self.fps) * policies * self.final_episodes


class Episodes(Options):
    """Arguments of `Agent.evaluate`."""

    episodes: Count
    speeds: SpeedModes
    fps: FrameRates
    seed: Seed
    policies: Actings
    baselines: BaselineNames


class TrainConfig(EnvConfig):
    """The whole config of `flowrep.train`."""

    total_frames: Count
    threads: Count
    compiled: bool
    log_every_frames: Count
    checkpoint_every_frames: Count
    resume: Text | None
    experiment: Text | None
    evaluation: Evaluation
    algorithm: Algorithm

    @model_validator(mode="after")
    def _learns_something(self) -> TrainConfig:
        if self.resume is not None:  # the config that the run stored counts instead
            return self
        key, frames = self.algorithm.first_update(self.num_envs)
        if frames > self.total_frames:
            value = getattr(self.algorithm, key)
            raise ValueError(
                f"algorithm.{key}={value}: the first update would come after {frames} frames, "
                f"and total_frames is {self.total_frames}: raise it, or lower algorithm.{key}"
            )
        return self


class EvaluateConfig(Command):
    """The whole config of `flowrep.evaluate`."""

    run: Annotated[Annotated[list[Text], Field(min_length=1)] | None, OneOrMore]
    algorithm: Trusted
    scene: SceneSection | None = None
    representations: MapOptions | None = None
    flow: FlowOptions | None = None
    motion: MotionChoice | None = None
    noise: dict[str, Any] | None = None
    speed: Annotated[SpeedModes, OneOrMore]
    fps: Annotated[FrameRates | None, OneOrMore]
    episodes: Count
    policy: Annotated[list[Text], Field(min_length=1), Distinct, OneOrMore]
    output: Text | None
    baselines: Annotated[BaselineNames, OneOrMore]
    seed: Seed
    num_envs: Count
    num_workers: Workers
    device: Device

    @property
    def other_policies(self) -> list[str]:
        """The policies that are not of `run`: scripts, modules, programs and saved agents."""
        return [name for name in self.policy if name not in get_args(Acting)]

    @model_validator(mode="after")
    def _fits_together(self) -> EvaluateConfig:
        others = self.other_policies
        if others and len(others) < len(self.policy):
            raise ValueError("policy: greedy and sampled are of runs; evaluate others separately")
        if others and self.run is not None:
            raise ValueError(f"run= and policy={others[0]} can't be combined: give one of them")
        if not others and self.run is None:
            raise ValueError("run needs a value: run=<a run's or a sweep's folder>")
        if others and self.scene is None:
            raise ValueError(f"scene needs a value for policy={others[0]}")
        maps = (self.representations or {}).values()
        for key in ("representations", "flow", "motion", "noise", "output"):
            # `_target_` alone is no map: it trusts a class that a run names.
            if key == "representations" and all(options.keys() == {"_target_"} for options in maps):
                continue
            if not others and getattr(self, key) is not None:
                raise ValueError(f"{key}= can't be combined with run=: a run has its own {key}")
        return self


class ViewConfig(Command):
    """The whole config of `flowrep.view`."""

    scene: SceneSection | None = None
    representations: MapOptions | None = None
    policy: Text
    algorithm: Trusted
    speed: SpeedMode
    fps: FrameRate | None
    path: Text | None
    output: Text | None
    seed: Seed
    episodes: Count
    sheet_rows: Count
    video: bool


def validated_run(plain: Any, source: str, trusted: Collection[str] = ()) -> TrainConfig:
    """Returns the config that a run stored.

    It may only name classes of flowrep, or `trusted` ones, which the user typed: a file that may
    come from somebody else must not decide what is imported.
    """
    if not isinstance(plain, Mapping):
        raise UsageError(f"{source} does not hold a run's config: restore the file")
    config = validated(TrainConfig, plain, source)
    known = {*ALGORITHMS, *([trusted] if isinstance(trusted, str) else trusted)}
    for key, target in config.classes.items():
        if target not in known:
            plus = "+" if key.startswith("representations") else ""  # no map of this command
            raise UsageError(
                f"{source} names code outside of flowrep, {target}: if you trust it, add "
                f"{plus}{key}={target}"
            )
    return config
