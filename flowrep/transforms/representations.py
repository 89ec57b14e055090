"""Builds the transforms for a list of representations, without computing anything twice."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Composite
from torchrl.envs.transforms import Compose, ExcludeTransform, Transform

from flowrep.geometry.checks import checked_number
from flowrep.transforms.estimated_flow import EstimatedFlow
from flowrep.transforms.flow import DEPTH_KEY, RAW_KEYS, FlowFactorize, Intrinsics, RawFlow
from flowrep.transforms.frame_stack import FrameStack
from flowrep.transforms.maps import Depth, Rgb, Segmentation
from flowrep.transforms.motion import EstimateCameraMotion
from flowrep.transforms.noise import NOISY_SENSORS, SensorNoise

# A user's transform may be given as its class (or a function), which is then called with out_keys.
Described: TypeAlias = Mapping[str, Any] | Transform | Callable[..., Transform] | None
Representations: TypeAlias = Sequence[str] | Mapping[str, Described]
Arguments = dict[str, Any]

_SOURCES = ("exact", "estimated")
_FLOW_OPTIONS = ("scale",)
_ESTIMATOR_OPTIONS = ("estimator", "weights", "preset", "min_side_px", "picture_scale")
# Each representation's transform, and the parameters of it that a user may set.
_OPTIONS: dict[str, tuple[type[Transform], tuple[str, ...]]] = {
    "rgb": (Rgb, ()),
    "seg": (Segmentation, ("encoding",)),
    "depth": (Depth, ("range_m", "missing")),
    "raw": (RawFlow, _FLOW_OPTIONS),
    "ego": (FlowFactorize, _FLOW_OPTIONS),
    "obj": (FlowFactorize, (*_FLOW_OPTIONS, "noise_scales")),
}
FRAMES_OF = {"seg2": "seg", "depth2": "depth"}  # the last k frames
FLOWS = ("raw", "ego", "obj")  # of two channels, u and v

REPRESENTATIONS: tuple[str, ...] = (*_OPTIONS, *FRAMES_OF)

_UNSCALED_KEY = "_raw"  # exact raw flow in px/step, for FlowFactorize
_PICTURE_KEY = ("sensor", "rgb")
# These stay in the TensorDict: the next step needs the pictures, the others are measurements.
_PICTURES_KEY = "_rgb2"
_ESTIMATED_FLOW_KEY = ("sensor", "flow")  # in px/step
_ESTIMATED_MOTION_KEY = ("sensor", "estimated_motion")
_NOISY_KEYS = {"depth": ("sensor", "noisy_depth"), "motion": ("sensor", "noisy_motion")}
_KEPT = (_PICTURES_KEY, _ESTIMATED_FLOW_KEY, _ESTIMATED_MOTION_KEY, *_NOISY_KEYS.values())


def representation_options(name: str) -> Arguments:
    """Returns a representation's options with their defaults.

    >>> representation_options("depth2")
    {'k': 2, 'range_m': 100.0, 'missing': 0.0}
    """
    _check_known("representation", [name], REPRESENTATIONS)
    stacked = _defaults(FrameStack, ("k",)) if name in FRAMES_OF else {}
    stacked |= {"rate_hz": None} if name in FLOWS else {}
    return stacked | _defaults(*_OPTIONS[FRAMES_OF.get(name, name)])


def _defaults(transform: type[Transform], names: Sequence[str]) -> Arguments:
    parameters = inspect.signature(transform).parameters
    return {name: parameters[name].default for name in names}


def representation_stack(
    representations: Representations,
    *,
    intrinsics: Intrinsics | None = None,
    prev_intrinsics: NestedKey | None = None,
    num_classes: int | None = None,
    compiled: bool = False,
    flow: str | Mapping[str, Any] = "exact",
    motion: str = "exact",
    noise: Mapping[str, float] | None = None,
    frame_rate_hz: float | None = None,
) -> Compose:
    """Returns the transforms that write the representations at the root of the TensorDict.

    Shared results are computed once: `["ego", "obj"]` factorises once, `["seg", "seg2"]` encodes
    once. Intermediate results are dropped, except the pictures behind estimated flow, which the
    next step needs, and measurements: `("sensor", "flow")`, estimated flow in px/step,
    `("sensor", "estimated_motion")`, `("sensor", "noisy_depth")` in metres and
    `("sensor", "noisy_motion")`.

    Args:
        representations: names from `REPRESENTATIONS`, which are also the keys in the TensorDict, or
            a mapping from name to options (see `representation_options`). The mapping may also hold
            transforms of your own, each under the name of the key that it writes; or their classes,
            which get `out_keys` and, if they have such arguments, `intrinsics` and
            `prev_intrinsics`. A representation that one of them reads is computed, but not written
            unless it is named, too.
        intrinsics: K `[3, 3]` of the sensor maps in pixels, or its key; raw, ego and obj need it,
            except for estimated raw flow. For `prev_intrinsics` see `RawFlow`.
        num_classes: number of semantic classes; seg and seg2 need it.
        compiled: whether flow is computed through `torch.compile`, see `RawFlow`.
        flow: source of raw flow, and thus of obj: `"exact"` (`RawFlow`), `"estimated"`
            (`EstimatedFlow`, from `("sensor", "rgb")`, compensated for the camera's motion if obj
            is chosen), or a mapping with one of them as `source` and options of `EstimatedFlow`.
            Ego flow is computed from depth and the camera's motion, so it depends on this source
            only if the motion is estimated.
        motion: source of the camera's motion for ego and obj: `"exact"`, the env's
            `("sensor", "prev_from_curr")`, or `"estimated"`, by `EstimateCameraMotion` from raw
            flow and depth, noisy if depth is. Odometry and its drift are then not used.
        noise: errors of the depth camera and of odometry: `depth_sigma_per_m`, `depth_dropout`,
            `drift_m` and `drift_rad` of `SensorNoise`, 0 by default. Depth, ego and obj are
            computed from the noisy values; raw flow and classes don't use these sensors. The noise
            is a function of the integers under `("sensor", "frame")`, which identify the frame.
        frame_rate_hz: the env's steps per second. With its option `rate_hz`, a flow is that of
            1 / `rate_hz` seconds, so that it means the same at any frame rate; else it is a step's.
            Episodes that are reset to another rate keep the env's.

    Raises:
        ValueError: a name, an option or a source is unknown, a value is invalid, or `intrinsics` or
            `num_classes` is missing.

    Example:
        >>> K = [[42.0, 0.0, 42.0], [0.0, 42.0, 42.0], [0.0, 0.0, 1.0]]
        >>> representation_stack(["ego"], intrinsics=K)
        Compose(
            FlowFactorize([('sensor', 'depth'), ('sensor', 'prev_from_curr')] -> ['ego']))
    """
    named, foreign = _with_options(representations, intrinsics, prev_intrinsics)
    read = [key for transform in foreign.values() for key in transform.in_keys]
    unnamed = {name: representation_options(name) for name in REPRESENTATIONS if name in read}
    chosen = unnamed | named
    if num_classes is None and not {"seg", "seg2"}.isdisjoint(chosen):
        raise ValueError("representations seg and seg2 need num_classes=")
    estimator = _estimator_options(flow)
    flows = {
        name: chosen[name] | {"scale": flow_scale(chosen[name], frame_rate_hz)}
        for name in FLOWS
        if name in chosen
    }
    if intrinsics is None and flows and (estimator is None or set(flows) != {"raw"}):
        raise ValueError(f"representations {', '.join(FLOWS)} need intrinsics=, the camera's K")
    _check_known("source of motion", [motion], _SOURCES)
    estimates_motion = motion == "estimated" and not {"ego", "obj"}.isdisjoint(flows)

    noisy = _noise(noise, chosen, reads_motion=motion == "exact")
    keys = {name: NOISY_SENSORS[name].key for name in _NOISY_KEYS}
    keys |= {name: key for name, key in _NOISY_KEYS.items() if noisy and key in noisy[0].out_keys}
    transforms = [*noisy, *_maps(chosen, num_classes, keys["depth"])]
    camera: Arguments = {"intrinsics": intrinsics, "prev_intrinsics": prev_intrinsics}
    motion_key = _ESTIMATED_MOTION_KEY if estimates_motion else keys["motion"]
    # RawFlow factorises exact flow in the same pass, but not by noisy depth.
    by_pass = [name for name in flows if name == "raw" or keys["depth"] == DEPTH_KEY]
    # Elsewhere, obj needs flow in px/step, as does an estimate of the motion.
    noise_scales = flows.get("obj", {}).get("noise_scales")
    splits = "obj" in flows and (estimator is not None or "obj" not in by_pass or noise_scales)
    needs_unscaled = splits or estimates_motion
    unscaled = _UNSCALED_KEY if estimator is None else _ESTIMATED_FLOW_KEY
    sources: list[Transform] = []
    if estimator is not None and (needs_unscaled or "raw" in flows):
        inputs = [_PICTURES_KEY, keys["depth"], motion_key]
        sources = _estimated_flow(flows, estimator, camera, inputs, estimates_motion)
    elif needs_unscaled:
        sources = [RawFlow(**camera, compiled=compiled, out_keys=unscaled)]
        if estimates_motion:
            sources.append(_motion([unscaled, keys["depth"]], camera))
    elif estimator is None and not {"raw", "obj"}.isdisjoint(flows):
        inputs = [*RAW_KEYS, *([] if by_pass == ["raw"] else [motion_key])]
        scales = {name: flows[name]["scale"] for name in by_pass}
        options: Arguments = {"outputs": by_pass, "scale": scales, "in_keys": inputs}
        sources = [RawFlow(**camera, **options, compiled=compiled)]
    for transform in sources:
        if transform.out_keys[0] not in flows:  # errors name the representations that need it
            transform.label = " and ".join(map(repr, flows))
    transforms += sources
    written_flows = {key for transform in sources for key in transform.out_keys}
    factors = {name: flows[name] for name in flows if name not in written_flows}
    if factors:
        factorize = FlowFactorize(
            **camera,
            compiled=compiled,
            outputs=list(factors),
            scale={name: options["scale"] for name, options in factors.items()},
            noise_scales=noise_scales,
            in_keys=[*([] if set(factors) == {"ego"} else [unscaled]), keys["depth"], motion_key],
        )
        transforms.append(factorize)
    transforms += foreign.values()
    written = dict.fromkeys(key for transform in transforms for key in transform.out_keys)
    shown = {*named, *_KEPT, *(key for each in foreign.values() for key in each.out_keys)}
    intermediate = [key for key in written if key not in shown]
    return Compose(*transforms, *([DropKeys(*intermediate)] if intermediate else []))


def flow_scale(options: Mapping[str, Any], frame_rate_hz: float | None) -> float:
    """Returns the factor on a flow in pixels per step, given its options and the frame rate."""
    if options["rate_hz"] is None:
        return options["scale"]
    rate_hz, given_hz = (
        checked_number(name, value, "a positive number", lambda x: x > 0)
        for name, value in (("rate_hz", options["rate_hz"]), ("frame_rate_hz", frame_rate_hz))
    )
    scale = checked_number("scale", options["scale"], "a finite number", lambda x: True)
    return scale * given_hz / rate_hz


class DropKeys(ExcludeTransform):
    """Drops keys, with all that is nested under them, at the root and under `"next"`."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns a batch without the keys."""
        keys = self.excluded_keys
        return tensordict.exclude(*keys, *(("next", key) for key in keys))

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Returns the specs without the keys; TorchRL's method only finds leaves."""
        for key in self.excluded_keys:
            del output_spec["full_observation_spec"][key]
        return output_spec


def _check_known(what: str, names: Iterable[object], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"unknown {what} {name!r}; known are {list(known)}")


def _known_options(whose: str, given: Any, known: Collection[str]) -> Arguments:
    """Returns the options that were given; raises ValueError if one of them is unknown."""
    if not isinstance(given, Mapping | None):
        raise ValueError(f"options of {whose} must be a mapping from name to value, got {given!r}")
    _check_known(f"option of {whose}:", given or {}, known)
    return dict(given or {})


def _with_options(
    representations: Representations, intrinsics: Any, prev_intrinsics: Any
) -> tuple[dict[str, Arguments], dict[str, Any]]:
    """Returns the representations with all of their options, and the user's transforms, by name."""
    if isinstance(representations, str) or not representations:
        raise ValueError(
            f"representations must be a list of names, some of {list(REPRESENTATIONS)}; "
            f"got {representations!r}"
        )
    chosen: dict[str, Arguments] = {}
    foreign: dict[str, Transform] = {}
    for name in representations:
        if name in chosen:
            raise ValueError(f"representation {name!r} is named twice")
        given = representations[name] if isinstance(representations, Mapping) else None
        if callable(given) and not isinstance(given, Transform):
            camera = {"intrinsics": intrinsics, "prev_intrinsics": prev_intrinsics}
            given = given(out_keys=name, **{k: camera[k] for k in camera if asks_for(given, k)})
        if isinstance(given, Transform):
            if name in REPRESENTATIONS or name not in given.out_keys:
                raise ValueError(
                    f"representation {name!r}: expected a transform that writes this key, and a "
                    f"name that isn't one of {list(REPRESENTATIONS)}; it writes {given.out_keys}"
                )
            foreign[name] = given
            continue
        options = representation_options(name)
        chosen[name] = options | _known_options(f"representation {name!r}", given, options)
    return chosen, foreign


def asks_for(maker: Callable[..., object], argument: str) -> bool:
    """Returns whether a class or function has an argument that isn't given yet."""
    given = getattr(maker, "keywords", {})  # of a functools.partial
    function = getattr(maker, "func", maker)
    if isinstance(function, type):  # TorchRL's metaclass hides the signature of a class
        function = function.__init__  # type: ignore[misc]
    return argument in inspect.signature(function).parameters and argument not in given


def _estimator_options(flow: str | Mapping[str, Any]) -> Arguments | None:
    """Returns `EstimatedFlow`'s options, or None if flow is exact."""
    options: Arguments = dict(flow) if isinstance(flow, Mapping) else {"source": flow}
    source = options.pop("source", None)
    _check_known("source of flow", [source], _SOURCES)
    known = _ESTIMATOR_OPTIONS if source == "estimated" else ()
    _known_options(f"{source} flow", options, known)
    return options if source == "estimated" else None


def _noise(
    noise: Mapping[str, float] | None, chosen: Collection[str], *, reads_motion: bool
) -> list[Transform]:
    """Returns one `SensorNoise` if a representation reads a noisy sensor.

    The exact values keep their keys, so that raw flow and a second pass over the same frames start
    from them.
    """
    options = {sensor: NOISY_SENSORS[sensor].options for sensor in _NOISY_KEYS}
    known = dict.fromkeys((name for names in options.values() for name in names), 0.0)
    given: Arguments = known | _known_options("noise", noise, known)
    frame: NestedKey = ("sensor", "frame")
    SensorNoise(**given, frame_key=frame)  # checks all values, used or not
    split = [name for name in chosen if name in ("ego", "obj")]
    readers = {  # raw flow is exact or estimated from pictures: it needs no noisy sensor
        "depth": [name for name in chosen if name in ("depth", "depth2", *split)],
        "motion": split if reads_motion else [],
    }
    noisy = [s for s in readers if readers[s] and any(given[name] for name in options[s])]
    if not noisy:
        return []
    transform = SensorNoise(
        sensors=noisy,
        **{name: given[name] for sensor in noisy for name in options[sensor]},
        frame_key=frame,
        out_keys=[_NOISY_KEYS[sensor] for sensor in noisy],
    )
    transform.label = " and ".join(readers["depth"])
    return [transform]


def _maps(
    chosen: Mapping[str, Arguments], num_classes: int | None, depth_key: NestedKey
) -> list[Transform]:
    """Returns the transforms of rgb, seg and depth, followed by those that stack their frames."""

    def one(name: str, key: str, options: Arguments) -> Transform:
        if name == "rgb":
            return Rgb(out_keys=key)
        if name == "seg":
            return Segmentation(num_classes, **options, out_keys=key)  # type: ignore[arg-type]
        return Depth(**options, in_keys=depth_key, out_keys=key)

    maps: list[Transform] = []
    stacks: list[Transform] = []
    for name, options in chosen.items():
        if name in FLOWS:
            continue
        if name not in FRAMES_OF:
            maps.append(one(name, name, options))
            continue
        frame = FRAMES_OF[name]
        of_frame = {option: value for option, value in options.items() if option != "k"}
        is_shared = chosen.get(frame) == of_frame
        key = frame if is_shared else f"_{frame}"
        if not is_shared:
            maps.append(one(frame, key, of_frame))
        stacks.append(FrameStack(k=options["k"], in_keys=key, out_keys=name))
    return maps + stacks


def _estimated_flow(
    flows: Mapping[str, Arguments],
    estimator: Arguments,
    camera: Arguments,
    inputs: list[NestedKey],
    estimates_motion: bool,
) -> list[Transform]:
    """Returns the transforms of picture pairs, flow and, with `estimates_motion`, camera motion.

    obj needs flow that is compensated for the camera's motion; `inputs` are the keys that it reads:
    pictures, depth and motion. If the motion is estimated, too, it is estimated from a first flow
    without compensation.
    """
    pictures = FrameStack(k=2, in_keys=[_PICTURE_KEY], out_keys=[_PICTURES_KEY])
    written: Arguments = {"outputs": ["unscaled"], "out_keys": [_ESTIMATED_FLOW_KEY]}
    first = written
    if "raw" in flows:
        written = {"outputs": ["unscaled", "raw"], "out_keys": [_ESTIMATED_FLOW_KEY, "raw"]}
        written["scale"] = flows["raw"]["scale"]
    motion = []
    if estimates_motion:
        motion = [_motion([_ESTIMATED_FLOW_KEY, inputs[1]], camera, _PICTURE_KEY)]
    if "obj" not in flows:
        return [pictures, EstimatedFlow(**estimator, **written, in_keys=_PICTURES_KEY), *motion]
    compensated = EstimatedFlow(**estimator, **written, **camera, in_keys=inputs)
    if not motion:
        return [pictures, compensated]
    # A coarser estimate is enough for the camera's motion.
    coarser = {"preset": "medium"} if estimator.get("preset") == "fine" else {}
    plain = EstimatedFlow(**estimator | coarser, **first, in_keys=_PICTURES_KEY)
    return [pictures, plain, *motion, compensated]


def _motion(
    in_keys: list[NestedKey], camera: Arguments, picture: NestedKey | None = None
) -> Transform:
    """Returns the transform that estimates the camera's motion from flow and depth."""
    written: Arguments = {"outputs": ["motion"], "out_keys": [_ESTIMATED_MOTION_KEY]}
    return EstimateCameraMotion(**camera, **written, picture=picture, in_keys=in_keys)
