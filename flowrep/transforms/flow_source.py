"""Builds the transforms behind raw, ego and obj, depending on the source of raw flow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict.utils import NestedKey
from torchrl.envs.transforms import Transform

from flowrep.transforms.base import unknown_name
from flowrep.transforms.estimated_flow import EstimatedFlow
from flowrep.transforms.flow import Intrinsics
from flowrep.transforms.flow_factorize import FlowFactorize
from flowrep.transforms.frame_stack import FrameStack
from flowrep.transforms.noise_source import Sensed
from flowrep.transforms.raw_flow import RawFlow

_UNSCALED = "_raw"  # raw flow in px/step: what FlowFactorize reads
PICTURES_KEY = "_rgb2"  # the previous and the current picture, kept for the next step
ESTIMATED_FLOW_KEY = ("sensor", "flow")  # takes the place of _UNSCALED for estimated flow

FLOW_SOURCES = ("exact", "estimated")
_ESTIMATOR_OPTIONS = ("estimator", "weights", "preset", "min_side_px")


def estimator_options(flow: str | Mapping[str, Any]) -> dict[str, Any] | None:
    """Returns `EstimatedFlow`'s options, or None if flow is exact."""
    options: dict[str, Any] = {"source": flow} if isinstance(flow, str) else dict(flow)
    source = options.pop("source", None)
    if source not in FLOW_SOURCES:
        raise ValueError(unknown_name("source of flow", source, FLOW_SOURCES))
    known = _ESTIMATOR_OPTIONS if source == "estimated" else ()
    for option in options:
        if option not in known:
            raise ValueError(unknown_name(f"option of {source} flow:", option, known))
    return options if source == "estimated" else None


def estimated_flow_makers(
    flows: dict[str, dict[str, Any]],
    estimator: dict[str, Any],
    intrinsics: Intrinsics | None,
    context: dict[str, Any],
    sensed: Sensed,
) -> list[Transform]:
    """Returns the counterparts of `exact_flow_makers`, with raw flow estimated from pictures."""
    makers: list[Transform] = []
    factors = {name: options for name, options in flows.items() if name != "raw"}
    if "raw" in flows or "obj" in flows:
        raw_options = flows.get("raw", {})
        raw = EstimatedFlow(
            **estimator,
            outputs=["unscaled", "raw"] if "raw" in flows else ["unscaled"],
            **raw_options,
            dt_s=context["dt_s"],
            in_keys=PICTURES_KEY,
            out_keys=[ESTIMATED_FLOW_KEY, "raw"] if "raw" in flows else [ESTIMATED_FLOW_KEY],
        )
        pictures = FrameStack(k=2, in_keys=[("sensor", "rgb")], out_keys=[PICTURES_KEY])
        pictures.label = raw.label = "raw and obj by estimated flow"
        makers += [pictures, raw]
    if factors and intrinsics is not None:
        reads: list[NestedKey] = [*sensed]
        makers.append(
            FlowFactorize(
                intrinsics,
                outputs=list(factors),
                scale={name: options["scale"] for name, options in factors.items()},
                unit={name: options["unit"] for name, options in factors.items()},
                in_keys=[ESTIMATED_FLOW_KEY, *reads] if "obj" in factors else reads,
                **context,
            )
        )
    return makers


def exact_flow_makers(
    flows: dict[str, dict[str, Any]],
    intrinsics: Intrinsics,
    context: dict[str, Any],
    sensed: Sensed,
) -> list[Transform]:
    """Returns one RawFlow if raw flow is needed, and one FlowFactorize if ego or obj is."""
    if "obj" in flows:
        raw = RawFlow(intrinsics, out_keys=_UNSCALED, **context)
        raw.label = "'obj'"
        factors = FlowFactorize(
            intrinsics,
            outputs=list(flows),
            scale={name: options["scale"] for name, options in flows.items()},
            unit={name: options["unit"] for name, options in flows.items()},
            in_keys=[_UNSCALED, *sensed],
            **context,
        )
        return [raw, factors]
    makers: list[Transform] = []
    if "raw" in flows:
        makers.append(RawFlow(intrinsics, **flows["raw"], **context))
    if "ego" in flows:
        ego = {"outputs": ["ego"], "in_keys": [*sensed], **flows["ego"]}
        makers.append(FlowFactorize(intrinsics, **ego, **context))
    return makers
