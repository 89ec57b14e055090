"""Builds the transforms for a list of representations, without computing anything twice."""

from __future__ import annotations

import inspect
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Composite
from torchrl.envs.transforms import Compose, ExcludeTransform, Transform

from flowrep.transforms.estimated_flow import EstimatedFlow
from flowrep.transforms.flow import FlowFactorize, Intrinsics, RawFlow
from flowrep.transforms.frame_stack import FrameStack
from flowrep.transforms.maps import Depth, Rgb, Segmentation
from flowrep.transforms.motion import EstimateCameraMotion
from flowrep.transforms.noise import SENSORS, SensorNoise

FLOW_SOURCES = MOTION_SOURCES = ("exact", "estimated")
NOISE_OPTIONS = SENSORS["depth"].options + SENSORS["motion"].options
_ESTIMATOR_OPTIONS = ("estimator", "weights", "preset", "min_side_px", "picture_scale")
_FLOW_OPTIONS = ("scale",)


class _Representation(NamedTuple):
    """A representation's transform and the parameters of it that a user may set."""

    transform: type[Transform]
    options: tuple[str, ...] = ()
    frames_of: str | None = None  # the representation whose last k frames it is


# In the order of computation.
_REPRESENTATIONS: dict[str, _Representation] = {
    "rgb": _Representation(Rgb),
    "seg": _Representation(Segmentation, ("encoding",)),
    "depth": _Representation(Depth, ("range_m", "missing")),
    "raw": _Representation(RawFlow, _FLOW_OPTIONS),
    "ego": _Representation(FlowFactorize, _FLOW_OPTIONS),
    "obj": _Representation(FlowFactorize, _FLOW_OPTIONS),
    "seg2": _Representation(Segmentation, ("encoding",), frames_of="seg"),
    "depth2": _Representation(Depth, ("range_m", "missing"), frames_of="depth"),
}
FLOWS = ("raw", "ego", "obj")  # of two channels, u and v

REPRESENTATIONS: tuple[str, ...] = tuple(_REPRESENTATIONS)

_UNSCALED_KEY = "_raw"  # exact raw flow in px/step, for FlowFactorize
_PICTURE_KEY = ("sensor", "rgb")
# Measurements, and what the next step needs, stay in the TensorDict.
_PICTURES_KEY = "_rgb2"
_ESTIMATED_FLOW_KEY = ("sensor", "flow")  # in px/step
_ESTIMATED_MOTION_KEY = ("sensor", "estimated_motion")
_NOISY_KEYS: dict[str, NestedKey] = {
    "depth": ("sensor", "noisy_depth"),
    "motion": ("sensor", "noisy_motion"),
}
_KEPT = (_PICTURES_KEY, _ESTIMATED_FLOW_KEY, _ESTIMATED_MOTION_KEY, *_NOISY_KEYS.values())


def representation_options(name: str) -> dict[str, Any]:
    """Returns a representation's options with their defaults.

    >>> representation_options("depth2")
    {'k': 2, 'range_m': 100.0, 'missing': 0.0}
    """
    _check_known("representation", [name], REPRESENTATIONS)
    entry = _REPRESENTATIONS[name]
    options = _defaults(FrameStack, ("k",)) if entry.frames_of else {}
    return options | _defaults(entry.transform, entry.options)


def _defaults(transform: type[Transform], names: Sequence[str]) -> dict[str, Any]:
    parameters = inspect.signature(transform).parameters
    return {name: parameters[name].default for name in names}


def representation_stack(
    representations: Sequence[str] | Mapping[str, Mapping[str, Any] | None],
    *,
    intrinsics: Intrinsics | None = None,
    prev_intrinsics: NestedKey | None = None,
    num_classes: int | None = None,
    compiled: bool = False,
    flow: str | Mapping[str, Any] = "exact",
    motion: str = "exact",
    noise: Mapping[str, float] | None = None,
) -> Compose:
    """Returns the transforms that write the representations at the root of the TensorDict.

    Shared results are computed once: `["ego", "obj"]` factorises once, `["seg", "seg2"]` encodes
    once. Intermediate results are dropped, except the pictures behind estimated flow, which the
    next step needs, and the sensors' measurements: `("sensor", "flow")`, estimated flow in px/step,
    `("sensor", "estimated_motion")`, `("sensor", "noisy_depth")` in metres and
    `("sensor", "noisy_motion")`.

    Args:
        representations: names, or a mapping from name to options (`representation_options`); a
            name is one of `REPRESENTATIONS`, its key in the TensorDict is the same.
        intrinsics: K `[3, 3]` of the sensor maps in pixels, or its key; raw, ego and obj need it,
            except for estimated raw flow. For `prev_intrinsics` see `RawFlow`.
        num_classes: number of semantic classes; seg and seg2 need it.
        compiled: whether flow is computed through `torch.compile`, see `RawFlow`.
        flow: source of raw flow, and thus of obj: `"exact"` (`RawFlow`), `"estimated"`
            (`EstimatedFlow`, from `("sensor", "rgb")`, compensated for the camera's motion if obj
            is chosen), or a mapping with one of them as `source` and further options of
            `EstimatedFlow`. Ego flow, computed from depth and the camera's motion, depends on it
            only if the motion is estimated.
        motion: source of the camera's motion for ego and obj: `"exact"`, the env's
            `("sensor", "prev_from_curr")`, or `"estimated"` (`EstimateCameraMotion`, from raw flow
            and depth, noisy if depth is; odometry is then not read, and its drift not drawn).
        noise: errors of the depth camera and of odometry: `depth_sigma_per_m`, `depth_dropout`,
            `drift_m` and `drift_rad` of `SensorNoise`, 0 by default. Depth, ego and obj are
            computed from the noisy values; raw flow and classes don't use these sensors. The noise
            depends on the frame that `("sensor", "frame")` names.

    Example:
        >>> K = [[42.0, 0.0, 42.0], [0.0, 42.0, 42.0], [0.0, 0.0, 1.0]]
        >>> representation_stack(["ego"], intrinsics=K)
        Compose(
            FlowFactorize([('sensor', 'depth'), ('sensor', 'prev_from_curr')] -> ['ego']))
    """
    chosen = _with_options(representations)
    if num_classes is None and not {"seg", "seg2"}.isdisjoint(chosen):
        raise ValueError("representations seg and seg2 need num_classes=")
    estimator = _estimator_options(flow)
    flows = {name: chosen[name] for name in FLOWS if name in chosen}
    if intrinsics is None and flows and (estimator is None or set(flows) != {"raw"}):
        raise ValueError(f"representations {', '.join(FLOWS)} need intrinsics=, the camera's K")
    _check_known("source of motion", [motion], MOTION_SOURCES)
    transforms, keys = _noise_transforms(noise, chosen, reads_motion=motion == "exact")
    transforms += _map_transforms(chosen, num_classes, keys["depth"])
    context = {"compiled": compiled}
    if motion == "estimated" and not {"ego", "obj"}.isdisjoint(flows):
        keys["motion"] = _ESTIMATED_MOTION_KEY
    camera = {"intrinsics": intrinsics, "prev_intrinsics": prev_intrinsics}
    transforms += _flow_transforms(flows, estimator, camera, keys, context)
    written = dict.fromkeys(key for transform in transforms for key in transform.out_keys)
    hidden = [key for key in written if key not in (*chosen, *_KEPT)]
    return Compose(*transforms, *([DropKeys(*hidden)] if hidden else []))


class DropKeys(ExcludeTransform):
    """Drops keys that no one needs any more, at the root and under `"next"`; nested ones whole."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns a batch without the keys."""
        keys = self.excluded_keys
        return tensordict.exclude(*keys, *(("next", key) for key in keys))

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Returns the specs without the keys; TorchRL's own looks for them among leaves alone."""
        for key in self.excluded_keys:
            del output_spec["full_observation_spec"][key]
        return output_spec


def _check_known(what: str, names: Iterable[object], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"unknown {what} {name!r}. There are {list(known)}")


def _with_options(
    representations: Sequence[str] | Mapping[str, Mapping[str, Any] | None],
) -> dict[str, dict[str, Any]]:
    if isinstance(representations, str) or not representations:
        raise ValueError(
            f"representations must be a list of names, some of {list(REPRESENTATIONS)}; "
            f"got {representations!r}"
        )
    chosen: dict[str, dict[str, Any]] = {}
    for name in representations:
        if name in chosen:
            raise ValueError(f"representation {name!r} is named twice")
        own = representations[name] if isinstance(representations, Mapping) else None
        options = representation_options(name)
        _check_known(f"option of representation {name!r}:", own or {}, options)
        chosen[name] = options | dict(own or {})
    return chosen


def _noise_transforms(
    noise: Mapping[str, float] | None, chosen: Collection[str], *, reads_motion: bool
) -> tuple[list[Transform], dict[str, NestedKey]]:
    """Returns one `SensorNoise`, if a representation reads a noisy sensor, and the keys to read.

    The exact values keep their keys, so that raw flow and a second pass over the same frames start
    from them.
    """
    given: dict[str, Any] = dict.fromkeys(NOISE_OPTIONS, 0.0)
    _check_known("option of noise:", noise or {}, given)
    given |= noise or {}
    SensorNoise(**given)  # checks all values, used or not
    readers = {  # raw flow is not measured by a depth camera
        "depth": [name for name in chosen if name in ("depth", "depth2", "ego", "obj")],
        "motion": [name for name in chosen if name in ("ego", "obj") and reads_motion],
    }
    options = {name: {o: given[o] for o in SENSORS[name].options} for name in readers}
    noisy = [name for name in readers if readers[name] and any(options[name].values())]
    keys = {name: SENSORS[name].key for name in readers}
    if not noisy:
        return [], keys
    transform = SensorNoise(
        sensors=noisy,
        **{o: given[o] for name in noisy for o in options[name]},
        frame_key=("sensor", "frame"),
        out_keys=[_NOISY_KEYS[name] for name in noisy],
    )
    transform.label = " and ".join(readers["depth"])
    return [transform], keys | {name: _NOISY_KEYS[name] for name in noisy}


def _map_transforms(
    chosen: dict[str, dict[str, Any]], num_classes: int | None, depth_key: NestedKey
) -> list[Transform]:
    """Returns the transforms of all representations except flow."""
    transforms: list[Transform] = []
    stacks: list[Transform] = []
    for name, options in chosen.items():
        if name in FLOWS:
            continue
        entry = _REPRESENTATIONS[name]
        key, frame = name, entry.frames_of or name
        frame_options = {option: options[option] for option in entry.options}
        if entry.frames_of:
            shared = chosen.get(frame) == frame_options
            key = frame if shared else f"_{frame}"
            stacks.append(FrameStack(k=options["k"], in_keys=key, out_keys=name))
            if shared:
                continue
        if frame == "seg":
            frame_options["num_classes"] = num_classes
        elif frame == "depth":
            frame_options["in_keys"] = depth_key
        transforms.append(entry.transform(**frame_options, out_keys=key))
    return transforms + stacks


def _estimator_options(flow: str | Mapping[str, Any]) -> dict[str, Any] | None:
    """Returns `EstimatedFlow`'s options, or None if flow is exact."""
    options: dict[str, Any] = {"source": flow} if isinstance(flow, str) else dict(flow)
    source = options.pop("source", None)
    _check_known("source of flow", [source], FLOW_SOURCES)
    known = _ESTIMATOR_OPTIONS if source == "estimated" else ()
    _check_known(f"option of {source} flow:", options, known)
    return options if source == "estimated" else None


def _flow_transforms(
    flows: dict[str, dict[str, Any]],
    estimator: dict[str, Any] | None,
    camera: dict[str, Any],
    keys: dict[str, NestedKey],
    context: dict[str, Any],
) -> list[Transform]:
    """Returns the sources of raw flow and of motion, if needed, and one FlowFactorize if it is."""
    transforms: list[Transform] = []
    factors = dict(flows)
    unscaled: NestedKey = _UNSCALED_KEY
    estimates_motion = keys["motion"] == _ESTIMATED_MOTION_KEY
    needs_unscaled = "obj" in flows or estimates_motion
    compensated: Transform | None = None
    if estimator is not None and ("raw" in flows or needs_unscaled):
        unscaled = _ESTIMATED_FLOW_KEY
        written = {"unscaled": unscaled} | ({"raw": "raw"} if "raw" in flows else {})
        options: dict[str, Any] = dict(factors.pop("raw", {}))
        options |= {"outputs": list(written), "out_keys": list(written.values())}
        transforms = [FrameStack(k=2, in_keys=[_PICTURE_KEY], out_keys=[_PICTURES_KEY])]
        if "obj" in flows:
            inputs = [_PICTURES_KEY, keys["depth"], keys["motion"]]
            options |= camera | {"in_keys": inputs}
            compensated = EstimatedFlow(**estimator, **options)
            # then for the camera's motion alone, which a coarser estimate tells
            options = {"outputs": ["unscaled"], "out_keys": unscaled}
            if estimator.get("preset") == "fine":
                options["preset"] = "medium"
        if compensated is None or estimates_motion:
            plain = estimator | options | {"in_keys": _PICTURES_KEY}
            transforms.append(EstimatedFlow(**plain))
    elif needs_unscaled:  # raw, too, is then made from the unscaled flow
        transforms = [RawFlow(**camera, out_keys=unscaled, **context)]
    elif "raw" in flows:
        transforms = [RawFlow(**camera, **factors.pop("raw"), **context)]
    if estimates_motion:
        estimate_motion = EstimateCameraMotion(
            **camera,
            picture=None if estimator is None else _PICTURE_KEY,
            outputs=["motion"],
            in_keys=[unscaled, keys["depth"]],
            out_keys=[_ESTIMATED_MOTION_KEY],
        )
        transforms.append(estimate_motion)
    if compensated is not None:
        transforms.append(compensated)
    for transform in transforms:
        if transform.out_keys[0] not in flows:  # errors name what is made of it
            transform.label = " and ".join(map(repr, flows))
    if factors:
        raw = [] if set(factors) == {"ego"} else [unscaled]
        split = FlowFactorize(
            **camera,
            outputs=list(factors),
            scale={name: options["scale"] for name, options in factors.items()},
            in_keys=[*raw, keys["depth"], keys["motion"]],
            **context,
        )
        transforms.append(split)
    return transforms
