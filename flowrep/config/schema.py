"""The commands' configs as pydantic models: every key, its type and its range.

`conf/` holds the values. The sections of algorithms, representations, flow and noise are in
`flowrep.options`.
"""

from __future__ import annotations

import inspect
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, Union, get_args, get_type_hints

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    PlainSerializer,
    Tag,
    ValidationError,
    WrapValidator,
    create_model,
    model_validator,
)

from flowrep.choices import FRAME_RATES_HZ, BaselineName, Renderer, SpeedMode
from flowrep.options import (
    ALGORITHMS,
    CLASS,
    AlgorithmOptions,
    Count,
    EstimatedFlowOptions,
    ExactFlowOptions,
    NoiseOptions,
    Options,
    Positive,
    RepresentationOptions,
    Text,
)
from flowrep.usage import UsageError

Model = TypeVar("Model", bound=BaseModel)

CountOrZero = Annotated[int, Field(ge=0, le=2**53)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]  # every library's generator takes these
FrameRate = Annotated[float, Field(ge=FRAME_RATES_HZ[0], le=FRAME_RATES_HZ[1])]
MotionChoice = Literal["exact", "estimated"]
Device = Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")]
Workers = CountOrZero | Literal["auto"]


def _distinct(values: Any) -> Any:
    if isinstance(values, tuple):  # from Python; a config has lists
        values = [*values]
    if isinstance(values, list) and any(x in values[:i] for i, x in enumerate(values)):
        raise ValueError("a value is repeated")
    return values


def _listed(value: Any) -> Any:
    return value if isinstance(value, list) or value is None else [value]


Distinct = BeforeValidator(_distinct)
OneOrMore = BeforeValidator(_listed)
"""Lets a list of one be written without brackets."""

Acting = Literal["greedy", "sampled"]
"""How an agent acts in its final evaluation."""
Actings = Annotated[list[Acting], Field(min_length=1), Distinct]
SpeedModes = Annotated[list[SpeedMode], Field(min_length=1), Distinct]
FrameRates = Annotated[list[FrameRate], Field(min_length=1), Distinct]
BaselineNames = Annotated[list[BaselineName], Distinct]


class Command(Options):
    """The whole config of a command; it keeps keys that it doesn't know, such as `+note=pilot`."""

    model_config = ConfigDict(extra="allow")

    @property
    def trusted(self) -> list[str]:
        """The classes outside of flowrep that it names; a stored run may name these, too."""
        return [*named_classes(self).values()]


def named_classes(config: Command) -> dict[str, str]:
    """Returns the classes that a config names, by the keys with which they are typed."""
    plain = config.plain()
    sections = {"algorithm": plain.get("algorithm") or {}}
    for name, options in (plain.get("representations") or {}).items():
        sections[f"representations.{name}"] = options
    targets = {f"{name}._target_": each.get("_target_") for name, each in sections.items()}
    return {key: target for key, target in targets.items() if target}


def _in_their_order(value: Any, check: Any) -> dict[str, Any]:
    """Checks options and returns them unchanged: a model would not keep the order of its keys."""
    if isinstance(value, Mapping) and not all(str(name).isidentifier() for name in value):
        raise ValueError("a name consists of letters, digits and _")
    check(value)
    if not value:
        raise ValueError("is empty; choose at least one: representations=[ego,obj]")
    if empty := [name for name, options in value.items() if options is None]:
        raise ValueError(f"{empty[0]} is null; leave it out instead")
    return {name: dict(options) for name, options in value.items()}


FlowSection = Annotated[ExactFlowOptions | EstimatedFlowOptions, Field(discriminator="source")]


class ForeignAlgorithm(AlgorithmOptions):
    """Options of a user's algorithm, which `experiment.build` checks."""

    model_config = ConfigDict(extra="allow")
    target: str = Field(alias="_target_", pattern=CLASS)


def _scene(value: Any) -> Any:
    """Returns a section `scene` as the `Scene` that it describes."""
    from flowrep.scenes import Scene, load_scene  # costs 0.1 s, which --help doesn't need

    if not isinstance(value, Mapping | Scene):  # a name would read a file
        raise ValueError(f"should be the keys of a scene, as in conf/scene, not {value!r}")
    return load_scene(value)


def _scene_data(scene: Any) -> Any:
    from flowrep.scenes.load import scene_data

    return scene_data(scene)


def _kind(section: Any) -> str:
    """Returns the tag of an algorithm's section in the union `Algorithm`."""
    if isinstance(section, Mapping):
        target = section.get("_target_")
    else:  # a model, or an invalid value
        target = getattr(section, "target", None)
    return target if isinstance(target, str) and target in ALGORITHMS else "foreign"


if TYPE_CHECKING:
    from flowrep.scenes import Scene

    Stack = dict[str, dict[str, Any]]
    Algorithm = AlgorithmOptions
else:
    Scene = Annotated[Any, BeforeValidator(_scene), PlainSerializer(_scene_data)]
    Stack = Annotated[
        RepresentationOptions, WrapValidator(_in_their_order), PlainSerializer(lambda value: value)
    ]
    Algorithm = Annotated[
        Union[
            Annotated[ForeignAlgorithm, Tag("foreign")],
            *(Annotated[options, Tag(target)] for target, options in ALGORITHMS.items()),
        ],
        Discriminator(_kind),
    ]
# pydantic puts a union's tag between the keys of an error's location.
_MEMBERS = {"exact", "estimated", "foreign", *ALGORITHMS}


class Trusted(Options):
    """A class outside of flowrep that a run's config may name."""

    target: Text | None = Field(alias="_target_")


# The commands.


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
    renderer: Renderer
    representations: Stack
    flow: FlowSection
    motion: MotionChoice
    noise: NoiseOptions
    scene: Scene

    @model_validator(mode="after")
    def _can_be_rendered(self) -> EnvConfig:
        if self.renderer == "pybullet" and getattr(self.flow, "picture_scale", 1) > 1:
            raise ValueError(
                "renderer=pybullet draws pictures only in the maps' size: add flow.picture_scale=1"
            )
        return self


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
    wandb: Literal["off", "offline", "online"]
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
        # A transition of all envs, and the step after it.
        least = (1 + getattr(self.algorithm, "n_steps", 1)) * self.num_envs
        capacity = getattr(self.algorithm, "replay_capacity", least)
        if capacity < least:
            raise ValueError(
                f"algorithm.replay_capacity={capacity} can't hold a transition of "
                f"num_envs={self.num_envs}: give at least {least}, or fewer envs"
            )
        return self


class EvaluateConfig(Command):
    """The whole config of `flowrep.evaluate`."""

    run: Annotated[Annotated[list[Text], Field(min_length=1)] | None, OneOrMore]
    algorithm: Trusted
    scene: Scene | None = None
    representations: Stack | None = None
    flow: FlowSection | None = None
    motion: MotionChoice | None = None
    noise: NoiseOptions | None = None
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
    video: CountOrZero

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
            if key == "representations" and all(options.keys() == {"_target_"} for options in maps):
                continue
            if not others and getattr(self, key) is not None:
                raise ValueError(f"{key}= can't be combined with run=: a run has its own {key}")
        return self


class ViewConfig(Command):
    """The whole config of `flowrep.view`."""

    scene: Scene
    representations: Stack | None = None
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


class ReportConfig(Command):
    """The whole config of `flowrep.report`."""

    run: Annotated[list[Text], Field(min_length=1), OneOrMore]
    output: Text | None
    policy: Acting
    trajectories: CountOrZero
    videos: CountOrZero


class Reader(Options):
    """A reader of recordings, whose options are checked against its signature."""

    model_config = ConfigDict(extra="allow")
    target: str = Field(alias="_target_", pattern=r"^flowrep\.sequences\.\w+$")

    def options(self) -> dict[str, Any]:
        """Returns the options by name, without the class."""
        return dict(self.model_extra or {})


class FlowScale(Options):
    """Flow of full colour, pixels."""

    raw: Positive
    ego: Positive
    obj: Positive


class FactorizeConfig(Command):
    """The whole config of `flowrep.factorize`."""

    input: Text | int
    output: Text
    format: Reader
    flow: FlowSection
    poses: Literal["recorded", "estimated"] | None
    check: Literal["error", "warn"]
    start: CountOrZero
    stop: CountOrZero | None
    stride: Count
    check_consistency: bool
    moving_px: Positive
    flow_files: Annotated[list[Literal["flo", "kitti", "npz"]], Distinct]
    masks: bool
    pictures_every: CountOrZero
    video: bool
    video_fps: Positive
    rerun: bool
    scale_px: FlowScale
    depth_range_m: Positive

    @model_validator(mode="after")
    def _has_a_pair(self) -> FactorizeConfig:
        if self.stop is not None and self.stop < self.start + self.stride + 1:
            least = self.start + self.stride + 1
            raise ValueError(f"stop={self.stop} leaves no pair of frames; give {least} or more")
        return self


def validated(schema: type[Model], plain: Mapping[str, Any], source: str = "") -> Model:
    """Returns a resolved config as its model; `source`, a file, begins the lines of an error."""
    try:
        return schema.model_validate(plain)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        if source and (absent := [_key(each) for each in errors if each["type"] == "missing"]):
            raise UsageError(f"{source} lacks {', '.join(absent)}; restore the file") from None
        lines = map(_line, errors)
        raise UsageError("\n".join(f"{source}: {x}" if source else x for x in lines)) from None


def validated_run(plain: Any, source: str, trusted: Collection[str] = ()) -> TrainConfig:
    """Returns the config that a run stored.

    It may only name classes of flowrep, or `trusted` ones, which the user typed: a file that may
    come from somebody else must not decide what is imported.
    """
    if not isinstance(plain, Mapping):
        raise UsageError(f"{source} does not hold a run's config: restore the file")
    config = validated(TrainConfig, plain, source)
    known = {*ALGORITHMS, *([trusted] if isinstance(trusted, str) else trusted)}
    for key, target in named_classes(config).items():
        if target not in known:
            plus = "+" if key.startswith("representations") else ""  # no map of this command
            raise UsageError(
                f"{source} names code outside of flowrep, {target}: if you trust it, add "
                f"{plus}{key}={target}"
            )
    return config


def check_reader_options(reader: type, options: Mapping[str, Any]) -> None:
    """Checks the section `format` against the reader's parameters, except for the first one."""
    # Not ???, which would not replace the value of the format that this one extends.
    for key in [key for key, value in options.items() if value == "needed"]:
        raise UsageError(f"format.{key} needs a value: format.{key}=...")
    hints = get_type_hints(reader.__init__)  # type: ignore[misc]
    _, *parameters = inspect.signature(reader).parameters.values()
    fields: dict[str, Any] = {
        p.name: (hints[p.name], ... if p.default is p.empty else p.default) for p in parameters
    }
    section: Any = create_model(reader.__name__, __base__=Options, **fields)
    validated(create_model("Config", format=(section, ...)), {"format": options})


def _key(details: Any) -> str:
    return ".".join(str(part) for part in details["loc"] if part not in _MEMBERS)


def _line(details: Any) -> str:
    """Returns one of pydantic's errors as a line that begins with the key."""
    key = _key(details)
    kind, value = details["type"], details["input"]
    message = details["msg"].removeprefix("Value error, ")
    if kind == "extra_forbidden":
        return f"{key}: there is no such key"
    if kind == "missing":
        return f"{key} needs a value: {key}=..."
    if kind == "value_error":
        names_itself = key == "" or message.startswith(f"{key} ")  # as those of a scene do
        return message if names_itself else f"{key}: {message}"
    remedy = ""
    if kind == "list_type" and isinstance(value, str | int | float):
        remedy = f"; write '{key}=[{value}]'"
    elif kind == "int_type" and isinstance(value, float) and value.is_integer():
        remedy = f"; write {value:.0f}"
    return f"{key}: {message[0].lower()}{message[1:]}, not {value!r}{remedy}"
