"""Optical flow split into the camera's and the objects' share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from flowrep import geometry
from flowrep.transforms.base import DEPTH, FLOW, MOTION, Keys
from flowrep.transforms.flow import FlowTransform, Intrinsics, checked_outputs, mask_key

_EGO_KEYS: list[NestedKey] = [("sensor", "depth"), ("sensor", "prev_from_curr")]


class FlowFactorize(FlowTransform):
    """Optical flow split into ego flow and object flow, in one pass over the pixels.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `"raw"`, px/step | `"ego"` | float `[*B, 2, H, W]` | any | `unit` × `scale` |
    | `("sensor", "depth")`, m | `"obj"` | float `[*B, 2, H, W]` | any | `unit` × `scale` |
    | `("sensor", "prev_from_curr")` | `"raw"` if chosen | as above | any | as above |
    | `"raw_valid"`, if there | `"valid"` if chosen | bool `[*B, 1, H, W]` | | |

    Convention: ego is the flow that the camera's motion alone would cause (Eqs. 7–11 of the
    paper), obj = raw − ego is the objects' own flow (Eq. 6), both p_t − p_t' on the current frame's
    grid, channels (u right, v down). `prev_from_curr` `[*B, 4, 4]` maps a point from the current
    camera's frame to the previous camera's. Flow is 0 where it isn't known: where depth is `nan`,
    the point was not in front of the previous camera, or the motion, K or raw flow isn't finite.
    Raw flow isn't known either where the mask beside it, bool `"raw_valid"` (`RawFlow` and
    `EstimatedFlow` write it; its key follows raw's), is False: a store of raw flow keeps both.
    With the simulator's raw flow, obj is exactly 0 on everything static.

    Args:
        intrinsics: K `[3, 3]` of the maps, a tensor or nested lists, pixels; or the env's key for
            it, `[*B, 3, 3]`.
        outputs: which of `"ego"`, `"obj"`, `"raw"` (the raw flow itself, in the chosen unit, 0
            where it isn't finite) and `"valid"` to write. With ego alone, raw flow isn't read.
        scale: factor on the flows, or a mapping from output to factor.
        unit: `"px_per_step"` or `"px_per_s"`, or a mapping from output to unit.
        dt_s: duration of a step in seconds; needed only for `"px_per_s"`.
        compiled: whether `compute` runs through `torch.compile`, which is some five times as fast
            on a CPU and equal up to rounding. Compiling takes up to a minute; later processes find
            the result in torch's cache. Otherwise numba, where it is installed, computes large
            float32 batches on a CPU two to five times as fast as PyTorch, with the same bits.
        in_keys: raw flow (in px/step, unscaled), depth and camera motion; without raw flow for ego
            alone.
        out_keys: one key per output; their names by default.

    Raises:
        ValueError: for a K that can't be one, an unknown output or unit, or `"px_per_s"` without
            `dt_s`.

    Example:
        The camera moved 0.1 m to the right, so a wall a metre away moves by fx · 0.1 = 5 px to the
        left; a pixel with a measured flow of 0 has an object flow of +5 px.

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
        compiled: bool = False,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        outputs = checked_outputs(outputs, ("ego", "obj", "raw", "valid"))
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
            compiled=compiled,
            in_keys=keys if in_keys is None else in_keys,
            out_keys=out_keys,
        )

    def _read(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Returns the inputs, with nan in raw flow where its mask says that it isn't known."""
        maps = super()._read(tensordict)
        known = tensordict.get(mask_key(self.in_keys[0]), None) if self.reads[0] == FLOW else None
        if known is None:
            return maps
        raw = maps[0]
        if known.dtype != torch.bool or known.shape != raw[..., :1, :, :].shape:
            raise ValueError(
                f"representation {self.label}: key {mask_key(self.in_keys[0])!r} should be bool "
                f"{list(raw[..., :1, :, :].shape)}, where {self.in_keys[0]!r} is known; "
                f"got {known.dtype} {list(known.shape)}"
            )
        return [torch.where(known, raw, math.nan), *maps[1:]]

    def compute(self, *maps: Tensor) -> tuple[Tensor, ...]:
        """Returns the chosen outputs, from (raw,) depth and camera motion (and K)."""
        (*raw, depth, motion), K = self._with_camera(maps)
        *raw, motion, depth, K = self._at_one_precision(*raw, motion, depth=depth, K=K)
        made: dict[str, Tensor] = {}
        if raw:
            factors = geometry.factorize(raw[0], depth, K, motion)
            made["ego"], made["obj"], made["valid"] = factors
            if "raw" in self.outputs:
                made["raw"] = torch.where(raw[0].isfinite(), raw[0], 0.0)
        else:
            made["ego"], made["valid"] = geometry.ego_flow(depth, K, motion)
        return tuple(
            made[name] if name == "valid" else self._in_unit(name, made[name])
            for name in self.outputs
        )
