"""Optical flow: the simulator's own, and its split into the camera's and the objects' share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Categorical, TensorSpec, Unbounded

from flowrep import geometry
from flowrep.transforms.base import DEPTH, FLOW, IDS, MOTION, MOTIONS, Keys, MapTransform, Reads

UNITS = ("px_per_step", "px_per_s")

_RAW_KEYS: list[NestedKey] = [
    ("sensor", "depth"),
    ("sensor", "instance"),
    ("sensor", "instance_motion"),
]
_EGO_KEYS: list[NestedKey] = [("sensor", "depth"), ("sensor", "prev_from_curr")]

Intrinsics = Tensor | Sequence[Sequence[float]]


class FlowTransform(MapTransform):
    """What flow transforms share: the intrinsics K, the outputs chosen and their unit.

    Args:
        intrinsics: K `[3, 3]` of the maps that are read, in pixels.
        reads: as in `MapTransform`.
        outputs: which of the class's outputs are written, in this order.
        scale: factor on every flow, or one an output.
        unit: `"px_per_step"` or `"px_per_s"`.
        dt_s: seconds a step lasts; needed for `"px_per_s"` alone.
        in_keys: as in `MapTransform`.
        out_keys: one key an output.
    """

    K: Tensor

    def __init__(
        self,
        intrinsics: Intrinsics,
        reads: Sequence[Reads],
        *,
        outputs: Sequence[str],
        scale: float | Mapping[str, float],
        unit: str | Mapping[str, str],
        dt_s: float | None,
        in_keys: Keys,
        out_keys: Keys | None,
    ) -> None:
        super().__init__(reads, in_keys, list(outputs) if out_keys is None else out_keys)
        if len(self.out_keys) != len(outputs):
            raise ValueError(
                f"{type(self).__name__} writes {list(outputs)}: out_keys needs as many keys, "
                f"got {self.out_keys}"
            )
        self.outputs = tuple(outputs)
        flows = [output for output in outputs if output != "valid"]
        scales = _per_output("scale", scale, flows)
        units = _per_output("unit", unit, flows)
        self.factors = {name: _factor(scales[name], units[name], dt_s) for name in flows}
        self.register_buffer("K", _as_intrinsics(intrinsics), persistent=False)

    def _in_unit(self, name: str, flow: Tensor) -> Tensor:
        factor = self.factors[name]
        return flow if factor == 1.0 else flow * factor

    def output_specs(self, *specs: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns an unbounded spec a flow and a boolean one for the mask."""
        depth = next(spec for spec, reads in zip(specs, self.reads) if reads is DEPTH)
        batch, size, device = depth.shape[:-3], depth.shape[-2:], depth.device
        return tuple(
            Categorical(2, shape=(*batch, 1, *size), device=device, dtype=torch.bool)
            if name == "valid"
            else Unbounded((*batch, 2, *size), device=device, dtype=depth.dtype)
            for name in self.outputs
        )


class RawFlow(FlowTransform):
    """Exact optical flow of a world of rigid bodies, as a simulator knows it.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "depth")`, m | `"raw"` | float `[*B, 2, H, W]` | any | `unit` × `scale` |
    | `("sensor", "instance")` | `"valid"` if asked for | bool `[*B, 1, H, W]` | | |
    | `("sensor", "instance_motion")` | | | | |

    Convention: p_t − p_t' on the current frame's grid, channels (u right, v down), t' the
    prior step (Eq. 1 of the paper).
    Row i of `instance_motion` `[*B, N, 4, 4]` takes a point that rides on instance i from the
    current camera's frame to where it was in the previous camera's frame; row 0 is the static
    world's. Everything of the previous step that flow needs is thus in the observation: nothing is
    remembered, and shuffled samples of a replay buffer give what the env gave.

    Args:
        intrinsics: K `[3, 3]` of the maps, a tensor or nested lists, pixels.
        outputs: of `"raw"` and `"valid"`, those that are written.
        scale: factor on the flow.
        unit: `"px_per_step"` or `"px_per_s"`.
        dt_s: seconds a step lasts; needed for `"px_per_s"` alone.
        invalid: flow where it isn't known (depth `nan`, or a point behind the previous camera).
        in_keys: depth, instance ids, motion an instance.
        out_keys: one key an output; their names by default.

    Raises:
        ValueError: for an unknown output or unit, or `"px_per_s"` without `dt_s`.

    Example:
        A body a metre away was 0.1 m further left: fx · 0.1 m / 1 m = 5 px to the right.

        >>> import torch
        >>> from tensordict import TensorDict
        >>> motions = torch.eye(4).repeat(2, 1, 1)
        >>> motions[1, 0, 3] = -0.1
        >>> sensor = {
        ...     "depth": torch.ones(1, 1, 2),
        ...     "instance": torch.tensor([[[0, 1]]]),
        ...     "instance_motion": motions,
        ... }
        >>> raw = RawFlow([[50.0, 0, 1], [0, 50.0, 0.5], [0, 0, 1]])
        >>> raw(TensorDict({"sensor": sensor}))["raw"][0, 0, 1]
        tensor(5.)
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        *,
        outputs: Sequence[str] = ("raw",),
        scale: float = 1.0,
        unit: str = "px_per_step",
        dt_s: float | None = None,
        invalid: float = 0.0,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        outputs = _checked_outputs(outputs, ("raw", "valid"))
        super().__init__(
            intrinsics,
            [DEPTH, IDS, MOTIONS],
            outputs=outputs,
            scale=scale,
            unit=unit,
            dt_s=dt_s,
            in_keys=_RAW_KEYS if in_keys is None else in_keys,
            out_keys=out_keys,
        )
        self.invalid = float(invalid)

    def compute(
        self, depth: Tensor, instance: Tensor, instance_motion: Tensor
    ) -> tuple[Tensor, ...]:
        """Returns the outputs asked for."""
        K = self.K.to(depth.dtype)
        flow, valid = geometry.rigid_flow(depth, instance, K, instance_motion)
        made = {"raw": self._in_unit("raw", flow) if "raw" in self.outputs else flow}
        if self.invalid != 0.0:
            made["raw"] = torch.where(valid, made["raw"], self.invalid)
        made["valid"] = valid
        return tuple(made[name] for name in self.outputs)


class FlowFactorize(FlowTransform):
    """Optical flow split into ego flow and object flow, in one pass over the pixels.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `"raw"`, px/step | `"ego"` | float `[*B, 2, H, W]` | any | `unit` × `scale` |
    | `("sensor", "depth")`, m | `"obj"` | float `[*B, 2, H, W]` | any | `unit` × `scale` |
    | `("sensor", "prev_from_curr")` | `"raw"` if asked for | as above | any | as above |
    | | `"valid"` if asked for | bool `[*B, 1, H, W]` | | |

    Convention: ego is the flow that the camera's motion alone would cause (Eqs. 7–11 of the
    paper), obj = raw − ego is what moves by itself (Eq. 6), both p_t − p_t' on the current frame's
    grid, channels (u right, v down). `prev_from_curr` `[*B, 4, 4]` takes a point in the current
    camera's frame into the previous camera's. Where depth is `nan`, a point was behind the previous
    camera or raw isn't finite, flow is 0. With the simulator's raw flow obj is exactly 0 on what
    stands still.

    Args:
        intrinsics: K `[3, 3]` of the maps, a tensor or nested lists, pixels.
        outputs: of `"ego"`, `"obj"`, `"raw"` (the raw flow itself, in the unit asked for, 0 where
            it isn't finite) and `"valid"`, those that are written. With ego alone raw flow isn't
            read at all.
        scale: factor on the flows, or a mapping from output to factor.
        unit: `"px_per_step"` or `"px_per_s"`, or a mapping from output to unit.
        dt_s: seconds a step lasts; needed for `"px_per_s"` alone.
        in_keys: raw flow (in px/step, unscaled), depth, camera motion; without the first for ego
            alone.
        out_keys: one key an output; their names by default.

    Raises:
        ValueError: for an unknown output or unit, or `"px_per_s"` without `dt_s`.

    Example:
        The camera went 0.1 m to the right, so a wall a metre away streams by fx · 0.1 = 5 px to
        the left; a pixel that was measured to stay where it is has object flow of +5 px.

        >>> import torch
        >>> from tensordict import TensorDict
        >>> motion = torch.eye(4)
        >>> motion[0, 3] = 0.1
        >>> raw = torch.tensor([[[-5.0, 0.0]], [[0.0, 0.0]]])
        >>> sensor = {"depth": torch.ones(1, 1, 2), "prev_from_curr": motion}
        >>> split = FlowFactorize([[50.0, 0, 1], [0, 50.0, 0.5], [0, 0, 1]])
        >>> td = split(TensorDict({"raw": raw, "sensor": sensor}))
        >>> td["ego"][0], td["obj"][0]
        (tensor([[-5., -5.]]), tensor([[0., 5.]]))
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        *,
        outputs: Sequence[str] = ("ego", "obj"),
        scale: float | Mapping[str, float] = 1.0,
        unit: str | Mapping[str, str] = "px_per_step",
        dt_s: float | None = None,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        outputs = _checked_outputs(outputs, ("ego", "obj", "raw", "valid"))
        reads, keys = [DEPTH, MOTION], _EGO_KEYS
        if {"obj", "raw"} & set(outputs):
            reads, keys = [FLOW, *reads], ["raw", *keys]
        super().__init__(
            intrinsics,
            reads,
            outputs=outputs,
            scale=scale,
            unit=unit,
            dt_s=dt_s,
            in_keys=keys if in_keys is None else in_keys,
            out_keys=out_keys,
        )

    def compute(self, *maps: Tensor) -> tuple[Tensor, ...]:
        """Returns the outputs asked for, from (raw,) depth and camera motion."""
        *raw, depth, motion = maps
        K = self.K.to(depth.dtype)
        made: dict[str, Tensor] = {}
        if raw:
            made["raw"] = raw[0]
            made["ego"], made["obj"], made["valid"] = geometry.factorize(raw[0], depth, K, motion)
        else:
            made["ego"], made["valid"] = geometry.ego_flow(depth, K, motion)
        if "raw" in self.outputs:
            made["raw"] = torch.where(raw[0].isfinite(), raw[0], 0.0)
        return tuple(
            made[name] if name == "valid" else self._in_unit(name, made[name])
            for name in self.outputs
        )


def _checked_outputs(outputs: Sequence[str], known: tuple[str, ...]) -> tuple[str, ...]:
    unknown = [name for name in outputs if name not in known]
    if isinstance(outputs, str) or unknown or not outputs or len(set(outputs)) != len(outputs):
        raise ValueError(f"outputs is a list of some of {list(known)}, each once; got {outputs!r}")
    return tuple(outputs)


def _per_output(option: str, value: object, flows: Sequence[str]) -> dict[str, object]:
    if not isinstance(value, Mapping):
        return dict.fromkeys(flows, value)
    if set(value) != set(flows):
        raise ValueError(f"{option} needs one value for each of {list(flows)}, got {dict(value)}")
    return dict(value)


def _factor(scale: object, unit: object, dt_s: float | None) -> float:
    if unit not in UNITS:
        raise ValueError(f"unit is one of {list(UNITS)}, got {unit!r}")
    factor = float(scale)  # type: ignore[arg-type]
    if not math.isfinite(factor) or factor == 0.0:
        raise ValueError(f"scale is a finite number other than 0, got {scale}")
    if unit == "px_per_step":
        return factor
    if dt_s is None or not dt_s > 0:
        raise ValueError(f"unit 'px_per_s' needs dt_s, the seconds that a step lasts; got {dt_s}")
    return factor / dt_s


def _as_intrinsics(intrinsics: Intrinsics) -> Tensor:
    K = torch.as_tensor(intrinsics)
    K = K.clone() if K.is_floating_point() else K.to(torch.get_default_dtype())
    if K.shape != (3, 3):
        raise ValueError(f"intrinsics is K, [3, 3]; got {list(K.shape)}")
    return K
