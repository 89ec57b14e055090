"""Builds the transforms for a list of representations, without computing anything twice."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from tensordict import TensorDictBase
from torchrl.envs.transforms import Compose, ExcludeTransform, Transform

from flowrep.transforms.base import unknown_name
from flowrep.transforms.depth import Depth
from flowrep.transforms.flow import Intrinsics
from flowrep.transforms.flow_factorize import FlowFactorize
from flowrep.transforms.flow_source import (
    ESTIMATED_FLOW_KEY,
    PICTURES_KEY,
    estimated_flow_makers,
    estimator_options,
    exact_flow_makers,
)
from flowrep.transforms.frame_stack import FrameStack
from flowrep.transforms.noise_source import (
    NOISY_DEPTH_KEY,
    NOISY_MOTION_KEY,
    Sensed,
    noise_makers,
)
from flowrep.transforms.raw_flow import RawFlow
from flowrep.transforms.rgb import Rgb
from flowrep.transforms.segmentation import Segmentation

_FLOW_OPTIONS = ("scale", "unit")


class _Recipe(NamedTuple):
    """A representation's transform and the parameters of it that a user may set."""

    transform: type[Transform]
    options: tuple[str, ...] = ()
    frames_of: str | None = None  # the representation whose last k frames it is


# In the order of computation.
_RECIPES: dict[str, _Recipe] = {
    "rgb": _Recipe(Rgb),
    "seg": _Recipe(Segmentation, ("encoding",)),
    "depth": _Recipe(Depth, ("range_m", "missing")),
    "raw": _Recipe(RawFlow, _FLOW_OPTIONS),
    "ego": _Recipe(FlowFactorize, _FLOW_OPTIONS),
    "obj": _Recipe(FlowFactorize, _FLOW_OPTIONS),
    "seg2": _Recipe(Segmentation, ("encoding",), frames_of="seg"),
    "depth2": _Recipe(Depth, ("range_m", "missing"), frames_of="depth"),
}
_FLOWS = ("raw", "ego", "obj")

REPRESENTATIONS: tuple[str, ...] = tuple(_RECIPES)


def representation_options(name: str) -> dict[str, Any]:
    """Returns a representation's options with their defaults, e.g. `range_m` of depth.

    Raises:
        ValueError: for an unknown name.

    Example:
        >>> representation_options("depth2")
        {'k': 2, 'range_m': 100.0, 'missing': 0.0}
    """
    if name not in _RECIPES:
        raise ValueError(unknown_name("representation", name, REPRESENTATIONS))
    recipe = _RECIPES[name]
    options = _defaults(FrameStack, ("k",)) if recipe.frames_of else {}
    return options | _defaults(recipe.transform, recipe.options)


def _defaults(transform: type[Transform], names: Sequence[str]) -> dict[str, Any]:
    parameters = inspect.signature(transform).parameters
    return {name: parameters[name].default for name in names}


def representation_stack(
    representations: Sequence[str] | Mapping[str, Mapping[str, Any] | None],
    *,
    intrinsics: Intrinsics | None = None,
    num_classes: int | None = None,
    dt_s: float | None = None,
    compiled: bool = False,
    flow: str | Mapping[str, Any] = "exact",
    noise: Mapping[str, float] | None = None,
) -> Compose:
    """Returns the transforms that write the representations at the root of the TensorDict.

    Shared results are computed once: `["ego", "obj"]` factorises once, `["seg", "seg2"]` encodes
    once. Intermediate results are dropped, except the pictures behind estimated flow, which the
    next step needs, and the sensors' measurements: `("sensor", "flow")`, estimated flow in px/step,
    `("sensor", "noisy_depth")` in metres and `("sensor", "noisy_motion")`.

    Args:
        representations: names, or a mapping from name to options (`representation_options`); a
            name is one of `REPRESENTATIONS`, its key in the TensorDict is the same.
        intrinsics: K `[3, 3]` of the sensor maps in pixels; raw, ego and obj need it, except for
            estimated raw flow.
        num_classes: number of semantic classes; seg and seg2 need it.
        dt_s: duration of a step in seconds; flow in `px_per_s` needs it.
        compiled: whether flow is computed through `torch.compile`, see `RawFlow`.
        flow: source of raw flow, and thus of obj: `"exact"` (`RawFlow`), `"estimated"`
            (`EstimatedFlow`, from `("sensor", "rgb")`), or a mapping with one of them as `source`
            and further options of `EstimatedFlow`. Ego flow doesn't depend on it, as it is computed
            from depth and the camera's motion alone.
        noise: errors of the depth camera and of odometry: `depth_sigma_per_m`, `depth_dropout`,
            `drift_m` and `drift_rad` of `SensorNoise`, 0 by default. Depth, ego and obj are
            computed from the noisy values; raw flow and classes don't use these sensors. The noise
            depends on the frame that `("sensor", "frame")` names.

    Raises:
        ValueError: for an unknown or repeated name, an unknown option, or a missing argument.

    Example:
        >>> K = [[42.0, 0.0, 42.0], [0.0, 42.0, 42.0], [0.0, 0.0, 1.0]]
        >>> representation_stack(["ego"], intrinsics=K)
        Compose(
            FlowFactorize([('sensor', 'depth'), ('sensor', 'prev_from_curr')] -> ['ego']))
    """
    chosen = _with_options(representations)
    if num_classes is None and ("seg" in chosen or "seg2" in chosen):
        raise ValueError("representations seg and seg2 need num_classes=")
    estimator = estimator_options(flow)
    flows = {name: chosen[name] for name in _FLOWS if name in chosen}
    if intrinsics is None and flows and not (estimator is not None and set(flows) == {"raw"}):
        raise ValueError(f"representations {', '.join(_FLOWS)} need intrinsics=, the camera's K")
    makers, sensed = noise_makers(noise, chosen)
    makers += _frame_makers(chosen, num_classes, sensed)
    context = {"dt_s": dt_s, "compiled": compiled}
    if estimator is not None:
        makers += estimated_flow_makers(flows, estimator, intrinsics, context, sensed)
    elif intrinsics is not None:
        makers += exact_flow_makers(flows, intrinsics, context, sensed)
    written = [key for maker in makers for key in maker.out_keys]
    kept = [*chosen, PICTURES_KEY, ESTIMATED_FLOW_KEY, NOISY_DEPTH_KEY, NOISY_MOTION_KEY]
    hidden = [key for key in written if key not in kept]
    return Compose(*makers, *([DropKeys(*hidden)] if hidden else []))


class DropKeys(ExcludeTransform):
    """Drops intermediate results of other transforms, at the root and under `"next"`."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns a batch without the keys."""
        return tensordict.exclude(
            *self.excluded_keys, *(("next", key) for key in self.excluded_keys)
        )


def _with_options(
    representations: Sequence[str] | Mapping[str, Mapping[str, Any] | None],
) -> dict[str, dict[str, Any]]:
    if isinstance(representations, str):
        raise ValueError(f"representations must be a list of names, e.g. [{representations!r}]")
    names = list(representations)
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"representation {name!r} is named {names.count(name)} times")
    given = representations if isinstance(representations, Mapping) else {}
    chosen = {}
    for name in names:
        options = representation_options(name)
        own = given.get(name) or {}
        if not isinstance(own, Mapping):
            raise ValueError(f"options of representation {name!r} are a mapping, got {own!r}")
        for option, value in own.items():
            if option not in options:
                raise ValueError(
                    unknown_name(f"option of representation {name!r}:", option, options)
                )
            options[option] = value
        chosen[name] = options
    if not chosen:
        raise ValueError(f"no representation is named; there are {list(REPRESENTATIONS)}")
    return chosen


def _frame_makers(
    chosen: dict[str, dict[str, Any]], num_classes: int | None, sensed: Sensed
) -> list[Transform]:
    """Returns the transforms of all representations except flow."""
    makers: list[Transform] = []
    stacks: list[Transform] = []
    for name, options in chosen.items():
        if name in _FLOWS:
            continue
        recipe = _RECIPES[name]
        key, frame = name, recipe.frames_of or name
        frame_options = {option: options[option] for option in recipe.options}
        if recipe.frames_of:
            shared = chosen.get(frame) == frame_options
            key = frame if shared else f"_{frame}"
            stacks.append(FrameStack(k=options["k"], in_keys=key, out_keys=name))
            if shared:
                continue
        if frame == "seg":
            frame_options["num_classes"] = num_classes
        elif frame == "depth":
            frame_options["in_keys"] = sensed.depth
        makers.append(recipe.transform(**frame_options, out_keys=key))
    return makers + stacks
