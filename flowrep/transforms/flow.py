"""Transforms that write optical flow: exact raw flow, and its split into ego and object flow."""

from __future__ import annotations

import math
import os
import shutil
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeAlias

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Categorical, TensorSpec, Unbounded

from flowrep import geometry
from flowrep.geometry.checks import check_name
from flowrep.transforms import base
from flowrep.transforms.base import Keys, MapTransform, Reads, as_keys, check_choice

Unit = Literal["px_per_step", "px_per_s"]

CAMERA = Reads((3, 3), "float")
_DEPTH: NestedKey = ("sensor", "depth")
_RAW_KEYS: Keys = [_DEPTH, ("sensor", "instance"), ("sensor", "instance_motion")]
EGO_KEYS: list[NestedKey] = [_DEPTH, ("sensor", "prev_from_curr")]

# K itself, or the key under which the env gives it.
Intrinsics: TypeAlias = Tensor | Sequence[Sequence[float]] | NestedKey


class CameraTransform(MapTransform):
    """Holds K in its original float type, even if the transform is cast to another.

    Raw flow, where it is the first input, becomes nan where the mask under `mask_key` is False. A
    key of K, `[*B, 3, 3]`, is read after all other keys.
    """

    K: Tensor | None

    def __init__(
        self,
        intrinsics: Intrinsics | None,
        reads: Sequence[Reads],
        in_keys: Keys,
        out_keys: Keys,
        writes: int = 1,
    ) -> None:
        K = None
        if intrinsics is not None:
            if isinstance(intrinsics, str) or all(isinstance(part, str) for part in intrinsics):
                reads, in_keys = [*reads, CAMERA], [*as_keys(in_keys), *as_keys([intrinsics])]
            else:
                K = as_intrinsics(intrinsics)
        super().__init__(reads, in_keys, out_keys, writes)
        self.register_buffer("K", K, persistent=False)

    def _read(self, tensordict: TensorDictBase) -> list[Tensor]:
        maps = super()._read(tensordict)
        key = mask_key(self.in_keys[0])
        if self.reads[0] != base.FLOW or (known := tensordict.get(key, None)) is None:
            return maps
        like = maps[0][..., :1, :, :]
        if known.dtype != torch.bool or known.shape != like.shape:
            raise ValueError(
                f"representation {self.label}: key {key!r}, where {self.in_keys[0]!r} is known, "
                f"should be bool {list(like.shape)}; got {known.dtype} {list(known.shape)}"
            )
        return [torch.where(known, maps[0], math.nan), *maps[1:]]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> CameraTransform:
        """Moves K between devices but keeps its type, as bfloat16 would round 319.5 px to 320."""
        exact = self.K
        super()._apply(fn, recurse)
        if exact is not None and self.K is not None:
            self.K = exact.to(self.K.device)
        return self


class FlowTransform(CameraTransform):
    """Base of flow transforms, with the intrinsics K, the chosen outputs and their unit.

    A subclass names the outputs that it knows, and those that are `masked`: beside them it writes
    where they are known, under `mask_key`. For the arguments see `RawFlow`.
    """

    known: tuple[str, ...]
    masked: tuple[str, ...] = ()

    def __init__(
        self,
        intrinsics: Intrinsics | None,
        reads: Sequence[Reads],
        in_keys: Keys,
        out_keys: Keys | None,
        outputs: Sequence[str],
        scale: float | Mapping[str, float],
        unit: str | Mapping[str, str],
        dt_s: float | None,
        compiled: bool = False,
    ) -> None:
        check_choice("outputs", outputs, self.known)
        keys = as_keys(list(outputs) if out_keys is None else out_keys)
        super().__init__(intrinsics, reads, in_keys, keys, writes=len(outputs))
        self.outputs = tuple(outputs)
        self.masks = [mask_key(key) for name, key in zip(outputs, keys) if name in self.masked]
        self.out_keys: list[NestedKey] = [*keys, *self.masks]
        flows = [output for output in outputs if output != "valid"]
        scales = _per_output("scale", scale, flows)
        units = _per_output("unit", unit, flows)
        self.is_per_second = "px_per_s" in units.values()
        self.factors = {name: _factor(scales[name], units[name], dt_s) for name in flows}
        if compiled:
            _check_compiler()
        self.compiled = bool(compiled)

    def _at_one_precision(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """Returns the inputs and K, the last, in depth's float type, at least float32."""
        # Raw and ego flow have to round alike, or obj is rounding noise on static pixels.
        (depth,) = (x for x, reads in zip(maps, self.reads) if reads == base.DEPTH)
        dtype = torch.promote_types(depth.dtype, torch.float32)
        maps = [*maps] if self.K is None else [*maps, self.K]
        return [x.to(dtype) if x.is_floating_point() else x for x in maps]

    def _written(self, made: Mapping[str, Tensor], valid: Tensor) -> tuple[Tensor, ...]:
        """Returns the chosen outputs, flows in their units, and the masks."""
        made = {
            name: made[name] if factor == 1.0 else made[name] * factor
            for name, factor in self.factors.items()
        }
        return (*(made.get(name, valid) for name in self.outputs), *[valid] * len(self.masks))

    def output_specs(self, *specs: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns an unbounded spec per flow and a boolean one per mask."""
        like = next((x for x, reads in zip(specs, self.reads) if reads == base.DEPTH), specs[0])
        batch, size, device = like.shape[:-3], like.shape[-2:], like.device
        self._warn_of_foreign_camera(size)
        flow = Unbounded(
            (*batch, 2, *size), device=device, dtype=torch.promote_types(like.dtype, torch.float32)
        )
        valid = Categorical(2, shape=(*batch, 1, *size), device=device, dtype=torch.bool)
        names = (*self.outputs, *["valid"] * len(self.masks))
        return tuple((valid if name == "valid" else flow).clone() for name in names)

    def _warn_of_foreign_camera(self, size: torch.Size) -> None:
        """Warns if the principal point is outside the maps, as K of a larger picture has it."""
        if self.K is None or not size[0] or not size[1]:
            return
        (cx, cy), (height, width) = self.K[:2, 2].tolist(), size
        if not (0 <= cx <= width and 0 <= cy <= height):
            warnings.warn(
                f"{type(self).__name__}: K has its principal point at ({cx:g}, {cy:g}), outside "
                f"the maps ({width} wide, {height} high): is it of a picture of another "
                "size? Scale its first two rows with the picture",
                stacklevel=2,
            )


class RawFlow(FlowTransform):
    """Exact optical flow of a world of rigid bodies, from a simulator's state.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "depth")`, m | `"raw"` | float `[*B, 2, H, W]` | any | `unit` × `scale` |
    | `("sensor", "instance")` | `"valid"` if chosen | bool `[*B, 1, H, W]` | | |
    | `("sensor", "instance_motion")` | `"raw_valid"` | as `"valid"` | | |

    Convention: p_t − p_t' on the current frame's grid, channels (u right, v down), t' the previous
    step (Eq. 1 of the paper). Row i of `instance_motion` `[*B, N, 4, 4]` maps a point fixed to
    instance i from the current camera's frame to its place in the previous camera's frame; row 0 is
    the static world's. The observation thus holds everything that flow needs of the previous step.
    Where flow isn't known, because depth is `nan` or a point was not in front of the previous
    camera, raw is 0 and the mask beside it, `"raw_valid"`, is False: `FlowFactorize` reads both.
    No state is kept, and shuffled samples of a replay buffer give the same flow as the env.

    Args:
        intrinsics: K `[3, 3]` of the maps, a tensor or nested lists, pixels; or the env's key for
            it, `[*B, 3, 3]`.
        outputs: which of `"raw"` and `"valid"` to write.
        scale: factor on the flow.
        unit: `"px_per_step"` or `"px_per_s"`.
        dt_s: duration of a step in seconds; needed only for `"px_per_s"`.
        compiled: whether `compute` runs through `torch.compile`, which is some five times as fast
            on a CPU and equal up to rounding. Compiling takes up to a minute; later processes find
            the result in torch's cache. Otherwise numba, where it is installed, computes large
            float32 batches on a CPU two to five times as fast as PyTorch, with the same bits.
        in_keys: depth, instance ids and one motion per instance.
        out_keys: one key per output; their names by default. The mask's key follows raw's:
            `("sensor", "flow_valid")` for `("sensor", "flow")`.

    Example:
        A body a metre away was 0.1 m further left: fx · 0.1 m / 1 m = 5 px to the right.

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

    known = ("raw", "valid")
    masked = ("raw",)

    def __init__(
        self,
        intrinsics: Intrinsics,
        *,
        outputs: Sequence[str] = ("raw",),
        scale: float = 1.0,
        unit: str = "px_per_step",
        dt_s: float | None = None,
        compiled: bool = False,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        reads = [base.DEPTH, base.IDS, base.MOTIONS]
        keys = _RAW_KEYS if in_keys is None else in_keys
        super().__init__(intrinsics, reads, keys, out_keys, outputs, scale, unit, dt_s, compiled)

    def compute(self, *maps: Tensor) -> tuple[Tensor, ...]:
        """Returns the chosen outputs, from depth, instance ids and motions (and K)."""
        depth, instance, motions, K = self._at_one_precision(maps)
        flow, valid = geometry.rigid_flow(depth, instance, K, motions)
        return self._written({"raw": flow}, valid)

    def output_specs(self, *specs: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns the outputs' specs; ids that say how many they are must be one per motion."""
        _, ids, motions, *_ = specs
        if isinstance(ids, Categorical) and ids.n != motions.shape[-3]:
            raise ValueError(
                f"{self.in_keys[1]!r} has ids from 0 to {ids.n - 1}, and {self.in_keys[2]!r} has "
                f"{motions.shape[-3]} rows: give InstanceIds one id for each body, in the order of "
                "the poses"
            )
        return super().output_specs(*specs)


class FlowFactorize(FlowTransform):
    """Optical flow split into ego flow and object flow, in one pass over the pixels.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `"raw"`, px/step | `"ego"` | float `[*B, 2, H, W]` | any | `unit` × `scale` |
    | `("sensor", "depth")`, m | `"obj"` | float `[*B, 2, H, W]` | any | `unit` × `scale` |
    | `("sensor", "prev_from_curr")` | `"raw"` if chosen | as above | any | as above |
    | `"raw_valid"`, if there | `"valid"` if chosen | bool `[*B, 1, H, W]` | | |

    Convention: ego is the flow that the camera's motion alone would cause (Eqs. 7–11 of the paper),
    obj = raw − ego is the objects' own flow (Eq. 6), with `RawFlow`'s sign, grid and channels. See
    `flowrep.geometry.factorize`, also for `prev_from_curr` and where flow isn't known and 0. Raw
    flow isn't known either where the mask beside it, bool `"raw_valid"` (`RawFlow` and
    `EstimatedFlow` write it; its key follows raw's), is False: a store of raw flow keeps both. With
    the simulator's raw flow, obj is exactly 0 on everything static.

    Args:
        intrinsics: K `[3, 3]` of the maps, or its key, see `RawFlow`.
        outputs: which of `"ego"`, `"obj"`, `"raw"` (the raw flow itself, in the chosen unit, 0
            where it isn't finite) and `"valid"` to write. With ego alone, raw flow isn't read.
        scale: factor on the flows, or a mapping from output to factor.
        unit: `"px_per_step"` or `"px_per_s"`, or a mapping from output to unit; for `dt_s` and
            `compiled` see `RawFlow`.
        in_keys: raw flow (in px/step, unscaled), depth and camera motion; without raw flow for ego
            alone.
        out_keys: one key per output; their names by default.

    Example:
        The camera moved 0.1 m to the right, so a wall a metre away moves by fx · 0.1 = 5 px to the
        left; a pixel with a measured flow of 0 has an object flow of +5 px.

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

    known = ("ego", "obj", "raw", "valid")

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
        reads: list[Reads] = [base.DEPTH, base.MOTION]
        keys: Keys = EGO_KEYS
        if {"obj", "raw"} & set(outputs):
            reads, keys = [base.FLOW, *reads], ["raw", *EGO_KEYS]
        keys = keys if in_keys is None else in_keys
        super().__init__(intrinsics, reads, keys, out_keys, outputs, scale, unit, dt_s, compiled)

    def compute(self, *maps: Tensor) -> tuple[Tensor, ...]:
        """Returns the chosen outputs, from (raw,) depth and camera motion (and K)."""
        *raw, depth, motion, K = self._at_one_precision(maps)
        if not raw:
            ego, valid = geometry.ego_flow(depth, K, motion)
            return self._written({"ego": ego}, valid)
        ego, obj, valid = geometry.factorize(raw[0], depth, K, motion)
        made = {"ego": ego, "obj": obj}
        if "raw" in self.outputs:
            made["raw"] = torch.where(raw[0].isfinite(), raw[0], 0.0)
        return self._written(made, valid)


def mask_key(flow: NestedKey) -> NestedKey:
    """Returns the key of the mask beside a raw flow: `"raw_valid"` for `"raw"`."""
    *path, name = (flow,) if isinstance(flow, str) else flow
    return (*path, f"{name}_valid") if path else f"{name}_valid"


def _per_output(option: str, value: object, flows: Sequence[str]) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        return dict.fromkeys(flows, value)
    if set(value) != set(flows):
        raise ValueError(f"{option} needs one value for each of {list(flows)}, got {dict(value)}")
    return dict(value)


def _factor(scale: float, unit: str, dt_s: float | None) -> float:
    check_name("unit", unit, Unit)
    if not math.isfinite(scale) or scale == 0.0:
        raise ValueError(f"scale must be a finite number other than 0, got {scale}")
    if unit == "px_per_step":
        return float(scale)
    if dt_s is None or not dt_s > 0:
        raise ValueError(f"unit 'px_per_s' needs dt_s, the seconds that a step lasts; got {dt_s}")
    return scale / dt_s


def as_intrinsics(intrinsics: Tensor | Sequence[Sequence[float]]) -> Tensor:
    """Returns K as a float tensor `[3, 3]`; raises ValueError if it is none."""
    K = torch.as_tensor(intrinsics)
    K = K.clone() if K.is_floating_point() else K.to(torch.get_default_dtype())
    if K.shape != (3, 3):
        raise ValueError(
            f"intrinsics is K, [3, 3], or the key of [*B, 3, 3] in the TensorDict; got "
            f"{list(K.shape)}"
        )
    geometry.check_intrinsics("intrinsics", K)
    return K


def _check_compiler() -> None:
    """Raises ValueError if the C++ compiler that `torch.compile` calls is not installed."""
    compiler = os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++")
    if sys.platform != "win32" and shutil.which(compiler) is None:
        raise ValueError(
            f"compiled=True needs a C++ compiler, and {compiler} is not on PATH: install it, name "
            "another one in the environment variable CXX, or set compiled=False"
        )
