"""Transforms that write optical flow: exact raw flow, and its split into ego and object flow."""

from __future__ import annotations

import math
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from flowrep import geometry
from flowrep.geometry.checks import checked_number
from flowrep.geometry.closed_form import as_type
from flowrep.transforms import base
from flowrep.transforms.base import (
    Keys,
    MapTransform,
    Reads,
    as_keys,
    check_choice,
    check_distinct_keys,
)

CAMERA = Reads((3, 3), "float")
DEPTH_KEY: NestedKey = ("sensor", "depth")
RAW_KEYS: list[NestedKey] = [DEPTH_KEY, ("sensor", "instance"), ("sensor", "instance_motion")]
EGO_KEYS: list[NestedKey] = [DEPTH_KEY, ("sensor", "prev_from_curr")]

_ROWS = 30  # rows or columns at least that estimate noise: a median of 900 values is good enough

# K itself, or the key under which the env gives it.
Intrinsics: TypeAlias = Tensor | Sequence[Sequence[float]] | NestedKey


class CameraTransform(MapTransform):
    """A transform that needs the camera's K: a constant, or read under a key of the TensorDict.

    A constant K keeps its float type, even if the transform is cast to another. If K is read, the
    last input keys are that of K, `[*B, 3, 3]`, and, unless K never changes, that of the previous
    frame's K. If the first input is raw flow, it becomes nan where the mask under `mask_key` is
    False.

    A constant K is checked in the constructor, and against the maps' size in specs and calls. A K
    under a key is checked at resets and at the root of batches; on a GPU, which such a check would
    wait for, only where all envs are reset. An unknown K (nan, inf or a focal length of 0) makes
    its frame invalid.

    Raises:
        ValueError: K doesn't fit the maps' size, see `check_intrinsics`; or K is read under a key,
            and `prev_intrinsics` is missing.
    """

    K: Tensor | None
    reads_previous_frame = True  # whether K of the previous frame matters
    needs_camera = True

    def __init__(
        self,
        intrinsics: Intrinsics | None,
        reads: Sequence[Reads],
        in_keys: Keys,
        out_keys: Keys,
        *,
        writes: int = 1,
        prev_intrinsics: NestedKey | None = None,
    ) -> None:
        # A key is a string or a tuple of strings; K is a tensor or rows of numbers.
        K, keys = None, []
        if intrinsics is None:
            if self.needs_camera:
                raise TypeError("intrinsics is K, [3, 3], or its key in the TensorDict; got None")
        elif isinstance(intrinsics, str) or all(isinstance(part, str) for part in intrinsics):
            keys = as_keys([intrinsics])
        else:
            K = as_intrinsics(intrinsics)
        if prev_intrinsics is not None:
            if not keys:
                raise ValueError(
                    "prev_intrinsics is the key of the previous frame's K; intrinsics has to be "
                    "the key of the current frame's"
                )
            keys += [key for key in as_keys([prev_intrinsics]) if key not in keys]
        elif keys and self.reads_previous_frame:
            raise ValueError(
                f"a K under a key, {keys[0]!r}, may change from frame to frame, and flow depends "
                "on both frames' K: give prev_intrinsics=, the key that PreviousIntrinsics writes, "
                f"or {keys[0]!r} again if K never changes within an episode"
            )
        reads = [*reads, *[CAMERA] * len(keys)]
        super().__init__(reads, [*as_keys(in_keys), *keys], out_keys, writes)
        self.register_buffer("K", K, persistent=False)
        self._rows = None if K is None else K.tolist()
        self.camera_keys = keys

    def _check_layout(self, batch: torch.Size, maps: Sequence[Any]) -> None:
        super()._check_layout(batch, maps)
        if self._rows is not None:
            geometry.camera.check_fit("intrinsics", self._rows, _map_size(maps, self.reads))

    def _check_values(self, tensordict: TensorDictBase, *, waits: bool = False) -> None:
        lacks = (tensordict.get(key, None) is None for key in self.in_keys)
        if not self.camera_keys or any(lacks):
            return
        maps = self._inputs(tensordict)
        for key, K in zip(self.camera_keys, maps[-len(self.camera_keys) :]):
            if base.has_values(K) and (waits or K.is_cpu):
                size = _map_size(maps, self.reads)
                geometry.check_intrinsics(f"key {key!r}", K, size, allow_unknown=True)

    def _tensors(self, tensordict: TensorDictBase) -> list[Tensor]:
        maps = super()._tensors(tensordict)
        if self.reads[0] != base.FLOW:
            return maps
        return [masked_flow(maps[0], self.in_keys[0], tensordict), *maps[1:]]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> CameraTransform:
        """Moves K between devices but keeps its type: bfloat16 would round 319.5 px to 320."""
        exact = self.K
        super()._apply(fn, recurse)
        if exact is not None and self.K is not None:
            self.K = exact.to(self.K.device)
        return self


class FlowTransform(CameraTransform):
    """Base of the flow transforms: K, the chosen outputs, and their scale.

    A subclass names the outputs that it can write (`known`), and those of them that come with a
    mask under `mask_key` (`masked`). For the arguments see `RawFlow`.
    """

    known: tuple[str, ...]
    masked: tuple[str, ...] = ()

    def __init__(
        self,
        intrinsics: Intrinsics | None,
        reads: Sequence[Reads],
        in_keys: Keys,
        out_keys: Keys | None,
        *,
        outputs: Sequence[str],
        scale: float | Mapping[str, float],
        compiled: bool = False,
        prev_intrinsics: NestedKey | None = None,
    ) -> None:
        check_choice("outputs", outputs, self.known)
        keys = as_keys(list(outputs) if out_keys is None else out_keys)
        options: Any = {"writes": len(outputs), "prev_intrinsics": prev_intrinsics}
        super().__init__(intrinsics, reads, in_keys, keys, **options)
        self.outputs = tuple(outputs)
        masks = [mask_key(key) for name, key in zip(outputs, keys) if name in self.masked]
        self.masks = [key for key in masks if key not in keys]
        self.out_keys: list[NestedKey] = [*keys, *self.masks]
        flows = [output for output in outputs if output != "valid"]
        self.scales = _scales(scale, flows)
        if compiled:
            _check_compiler()
        self.compiled = bool(compiled)

    def _at_one_precision(self, maps: Sequence[Tensor]) -> list[Any]:
        """Returns the inputs, K, and the previous K or None, in depth's type, at least float32."""
        # Raw and ego flow have to round alike, or obj is rounding noise on static pixels.
        dtype = torch.promote_types(maps[self.reads.index(base.DEPTH)].dtype, torch.float32)
        maps = [*maps] if self.K is None else [*maps, self.K]
        maps = [as_type(x, dtype) if x.is_floating_point() else x for x in maps]
        # With two keys, K and the previous K are the last of the maps already.
        return maps if len(self.camera_keys) == 2 else [*maps, None]

    def _chosen(
        self, flows: Mapping[str, Tensor], valid: Tensor, mask: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """Returns the chosen outputs, flows times their scales, and masks, by default `valid`."""
        mask = valid if mask is None else mask
        scaled = {
            name: flows[name] if scale == 1.0 else flows[name] * scale
            for name, scale in self.scales.items()
        }
        return (*(scaled.get(name, valid) for name in self.outputs), *[mask] * len(self.masks))

    def output_specs(self, *specs: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns an unbounded spec for each flow and a boolean one for each mask."""
        like = next((x for x, reads in zip(specs, self.reads) if reads == base.DEPTH), specs[0])
        batch, size, device = like.shape[:-3], like.shape[-2:], like.device
        flow = Unbounded(
            (*batch, 2, *size), device=device, dtype=torch.promote_types(like.dtype, torch.float32)
        )
        valid = Categorical(2, shape=(*batch, 1, *size), device=device, dtype=torch.bool)
        names = (*self.outputs, *["valid"] * len(self.masks))
        return tuple((valid if name == "valid" else flow).clone() for name in names)


class RawFlow(FlowTransform):
    """Exact optical flow of a world of rigid bodies, from a simulator's state.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `("sensor", "depth")`, m | `"raw"` | float `[*B, 2, H, W]` | any | px/step × `scale` |
    | `("sensor", "instance")` | `"ego"`, `"obj"` if chosen | as `"raw"` | any | as `"raw"` |
    | `("sensor", "instance_motion")` | `"valid"` if chosen | bool `[*B, 1, H, W]` | | |
    | `("sensor", "prev_from_curr")`, for ego, obj | `"raw_valid"` | as `"valid"` | | |

    Convention: p_t − p_t' on the current frame's grid, channels (u right, v down), t' the previous
    step (Eq. 1 of the paper). Row i of `instance_motion` `[*B, 1 + N, 4, 4]` takes a point fixed to
    instance i from the current camera's frame into the previous camera's, at the previous step; row
    0 is the static world's. At a reset nothing has moved, so flow is 0. No state is kept: shuffled
    samples of a replay buffer give the same flow as the env.

    Where flow isn't known, because depth is `nan` or a point was not in front of the previous
    camera, raw is 0 and the mask beside it, `"raw_valid"`, is False. `FlowFactorize` reads both.
    With ego or obj, the result is that of both transforms, in less time.

    Args:
        intrinsics: K `[3, 3]` of the maps, a tensor or nested lists, pixels; or the env's key for
            it, `[*B, 3, 3]`.
        prev_intrinsics: key of the previous frame's K, see `PreviousIntrinsics`; needed if
            `intrinsics` is a key. The same key says that K never changes within an episode.
        outputs: which of `"raw"`, `"ego"`, `"obj"` and `"valid"` to write; see `FlowFactorize`.
        scale: factor on the flow, finite and not 0; the frame rate gives pixels per second. Or a
            mapping from output to factor.
        compiled: whether `compute` runs through `torch.compile`, which is about five times as fast
            as PyTorch on a CPU and equal up to rounding. Compiling takes up to a minute; later
            processes take the result from torch's cache. If False, and numba is installed, float32
            maps on a CPU are computed by numba, bit for bit as by PyTorch and faster than compiled;
            a single small one only if something has imported numba, as flowrep's streets do.
        in_keys: depth, instance ids, and one motion for each instance; for ego and obj, also the
            camera's motion.
        out_keys: one key for each output; their names by default. The mask's key is raw's with
            `_valid` appended: `("sensor", "flow_valid")` for `("sensor", "flow")`.

    Raises:
        ValueError: an option or K is invalid, or `compiled=True` without a C++ compiler. In calls,
            see `check_intrinsics`.
        RuntimeError: in calls, for an id without a row of `instance_motion`.

    Example:
        A body a metre away was 0.1 m further left: fx · 0.1 m / 1 m = 3 px to the right.

        >>> from tensordict import TensorDict
        >>> motions = torch.eye(4).repeat(2, 1, 1)
        >>> motions[1, 0, 3] = -0.1
        >>> sensor = {
        ...     "depth": torch.ones(1, 1, 2),
        ...     "instance": torch.tensor([[[0, 1]]]),
        ...     "instance_motion": motions,
        ... }
        >>> raw = RawFlow([[30.0, 0, 1], [0, 30.0, 0.5], [0, 0, 1]])
        >>> raw(TensorDict({"sensor": sensor}))["raw"][0, 0, 1]
        tensor(3.)
    """

    known = ("raw", "ego", "obj", "valid")
    masked = ("raw",)

    def __init__(
        self,
        intrinsics: Intrinsics,
        *,
        prev_intrinsics: NestedKey | None = None,
        outputs: Sequence[str] = ("raw",),
        scale: float | Mapping[str, float] = 1.0,
        compiled: bool = False,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        reads, keys = [base.DEPTH, base.IDS, base.MOTIONS], RAW_KEYS
        if {"ego", "obj"} & set(outputs):
            reads, keys = [*reads, base.MOTION], [*RAW_KEYS, EGO_KEYS[-1]]
        keys = as_keys(keys if in_keys is None else in_keys)
        options: Any = {"outputs": outputs, "scale": scale, "compiled": compiled}
        options |= {"prev_intrinsics": prev_intrinsics}
        super().__init__(intrinsics, reads, keys, out_keys, **options)

    def compute(self, *maps: Tensor) -> tuple[Tensor, ...]:
        """Returns the chosen outputs, from depth, instance ids and motions (and K)."""
        depth, instance, motions, *motion, K, prev_K = self._at_one_precision(maps)
        given = depth, instance, K, motions, *motion
        if not motion:
            flow, known = geometry.rigid_flow(*given, prev_K=prev_K)
            return self._chosen({"raw": flow}, known)
        (flow, known), (ego, obj, valid) = geometry.flow.rigid_factors(*given, prev_K=prev_K)
        return self._chosen({"raw": flow, "ego": ego, "obj": obj}, valid, known)

    def output_specs(self, *specs: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns the outputs' specs; ValueError unless ids' spec has a number for each motion."""
        _, ids, motions, *_ = specs
        if motions.shape[-3] > 1:  # without bodies, an id is wrong or the static world's
            self._check_rows(_highest_id(ids), motions)
        return super().output_specs(*specs)

    def _check_values(self, tensordict: TensorDictBase, *, waits: bool = False) -> None:
        super()._check_values(tensordict, waits=waits)
        # A batch has no specs, but may have an InstanceIds beside it.
        _, ids, motions, *_ = self.in_keys
        for each in self._beside():
            if ids in each.out_keys and hasattr(each, "body_ids") and motions in tensordict:
                self._check_rows(len(each.body_ids), tensordict[motions])

    def _check_rows(self, bodies: int | None, motions: Tensor | TensorSpec) -> None:
        if bodies != (rows := motions.shape[-3]) - 1:
            found = "has a spec of any id" if bodies is None else f"has ids from 0 to {bodies}"
            raise ValueError(
                f"{self.in_keys[1]!r} {found}, and {self.in_keys[2]!r} has {rows} rows: that must "
                f"be 1 + N rows, the static world's first, and ids from 0 to N, declared as such. "
                "(Poses are N, of bodies alone: InstanceMotion adds the static world's row.) "
                "InstanceIds, with one id for each pose in their order, declares its ids"
            )


class FlowFactorize(FlowTransform):
    """Raw flow split into ego flow and object flow, in one pass over the pixels.

    | reads | writes | shape | range | unit |
    | --- | --- | --- | --- | --- |
    | `"raw"`, px/step | `"ego"` | float `[*B, 2, H, W]` | any | px/step × `scale` |
    | `("sensor", "depth")`, m | `"obj"` | float `[*B, 2, H, W]` | any | px/step × `scale` |
    | `("sensor", "prev_from_curr")` | `"raw"` if chosen | as above | any | as above |
    | `"raw_valid"`, if there | `"valid"` if chosen | bool `[*B, 1, H, W]` | | |
    | `movable`, if given | `"raw_valid"` with raw | as `"valid"` | | |

    Convention: ego is the flow that the camera's motion alone would cause (Eqs. 7–11 of the paper),
    obj = raw − ego is the flow of what moves by itself (Eq. 6), with `RawFlow`'s sign, grid and
    channels; see `flowrep.geometry.factorize`. With the simulator's raw flow, obj is exactly 0 on
    everything static.

    Raw flow is unknown where its mask, bool under raw's key with `_valid` appended, is False.
    `RawFlow` and `EstimatedFlow` write the mask; a buffer that stores raw flow has to store it,
    too. Where ego or raw flow is unknown, obj is 0 and `"valid"` False.

    Args:
        intrinsics: K `[3, 3]` of the maps, or its key; see `RawFlow`, as for `prev_intrinsics`.
        outputs: which of `"ego"`, `"obj"`, `"raw"` (raw flow times its scale, 0 where it isn't
            finite) and `"valid"` to write. For ego alone, raw flow isn't read.
        scale: factor on the flows, or a mapping from output to factor.
        movable: key of a mask or ids `[*B, 1, H, W]`, 0 where nothing can move by itself, such as a
            detector's mask of people. Object flow is 0 there, whatever an error of the camera's
            motion (odometry's drift) would leave.
        noise_scales: object flow of up to this many times its noise is 0; 2 is a good choice where
            no mask says what can move. The noise is a robust estimate from the frame, see
            `residual_noise`, and 0 if most pixels agree exactly with the camera's motion.
        compiled: see `RawFlow`.
        in_keys: raw flow (in px/step, unscaled), depth and camera motion; for ego alone, only the
            last two.
        out_keys: one key for each output; their names by default.

    Raises:
        ValueError: see `RawFlow`.

    Example:
        The camera moved 0.1 m to the right, so a wall a metre away moves by fx · 0.1 = 3 px to the
        left; a pixel with a measured flow of 0 has an object flow of +3 px.

        >>> from tensordict import TensorDict
        >>> motion = torch.eye(4)
        >>> motion[0, 3] = 0.1
        >>> raw = torch.tensor([[[-3.0, 0.0]], [[0.0, 0.0]]])
        >>> sensor = {"depth": torch.ones(1, 1, 2), "prev_from_curr": motion}
        >>> split = FlowFactorize([[30.0, 0, 1], [0, 30.0, 0.5], [0, 0, 1]])
        >>> td = split(TensorDict({"raw": raw, "sensor": sensor}))
        >>> td["ego"][0], td["obj"][0]
        (tensor([[-3., -3.]]), tensor([[0., 3.]]))
    """

    known = ("ego", "obj", "raw", "valid")
    masked = ("raw",)

    def __init__(
        self,
        intrinsics: Intrinsics,
        *,
        prev_intrinsics: NestedKey | None = None,
        outputs: Sequence[str] = ("ego", "obj"),
        scale: float | Mapping[str, float] = 1.0,
        movable: NestedKey | None = None,
        noise_scales: float | None = None,
        compiled: bool = False,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        reads: list[Reads] = [base.DEPTH, base.MOTION]
        keys: Keys = EGO_KEYS
        if {"obj", "raw"} & set(outputs):
            reads, keys = [base.FLOW, *reads], ["raw", *EGO_KEYS]
        keys = as_keys(keys if in_keys is None else in_keys)
        if movable is not None:
            if "obj" not in outputs:
                raise ValueError(f"movable={movable!r} is for obj, which {list(outputs)} lacks")
            reads, keys = [*reads, Reads((1, "H", "W"))], [*keys, *as_keys([movable])]
        options: Any = {"outputs": outputs, "scale": scale, "compiled": compiled}
        options |= {"prev_intrinsics": prev_intrinsics}
        super().__init__(intrinsics, reads, keys, out_keys, **options)
        self.has_movable = movable is not None
        self.noise_scales = noise_scales
        if noise_scales is not None:
            wanted = "a finite number of at least 0"
            self.noise_scales = checked_number(
                "noise_scales", noise_scales, wanted, lambda x: x >= 0
            )
            if "obj" not in outputs:
                raise ValueError(f"noise_scales={noise_scales} is for obj, which {outputs} lacks")
        if self.scales.get("raw", 1.0) != 1.0:
            check_distinct_keys(self)

    def compute(self, *maps: Tensor) -> tuple[Tensor, ...]:
        """Returns the chosen outputs, from (raw,) depth and camera motion (and movable, K)."""
        *raw, depth, motion, K, prev_K = self._at_one_precision(maps)
        if self.has_movable:
            *raw, depth, motion, movable = [*raw, depth, motion]
        if not raw:
            ego, valid = geometry.ego_flow(depth, K, motion, prev_K=prev_K)
            return self._chosen({"ego": ego}, valid)
        ego, obj, valid = geometry.factorize(raw[0], depth, K, motion, prev_K=prev_K)
        if self.noise_scales:
            # `norm` along the channels takes 40 times as long.
            length = torch.hypot(obj[..., :1, :, :], obj[..., 1:, :, :])
            noise = residual_noise(length, depth, valid)
            obj = torch.where(length > self.noise_scales * noise, obj, 0.0)
        if self.has_movable:
            obj = torch.where(movable != 0, obj, 0.0)
        flows, known = {"ego": ego, "obj": obj}, None
        if "raw" in self.outputs:
            flows["raw"] = torch.where(raw[0].isfinite(), raw[0], 0.0)
            known = raw[0].isfinite().all(-3, keepdim=True)
        return self._chosen(flows, valid, known)


def residual_noise(length: Tensor, depth: Tensor, known: Tensor) -> Tensor:
    """Returns the usual length of residuals at each pixel's depth; all are `[*B, 1, H, W]`.

    An error of the camera's rotation moves all pixels alike, an error of its translation by f / Z.
    The length is therefore a line in 1 / Z, neither falling nor negative, through the medians of
    the nearer and of the farther half of the known pixels (Tukey's resistant line). What moves by
    itself doesn't change it, as long as it covers less than half of each.
    """
    near = depth.reciprocal()
    step = max(1, min(depth.shape[-2:]) // _ROWS)
    sampled = (x[..., ::step, ::step] for x in (length, near, known))
    lengths, nearness, is_known = sampled
    is_known = is_known.view(torch.uint8) != 0  # as in `masked_flow`

    def median(of: Tensor, where: Tensor) -> Tensor:
        return torch.where(where, of, math.nan).flatten(-2).nanmedian(-1).values[..., None, None]

    is_far = nearness <= median(nearness, is_known)
    (x, y), (x_far, y_far) = (
        (median(nearness, half & is_known), median(lengths, half & is_known))
        for half in (~is_far, is_far)
    )
    slope = torch.where(x > x_far, (y - y_far) / (x - x_far), 0.0).clamp(min=0.0)
    return (y_far - slope * x_far).clamp(min=0.0) + slope * near


def _highest_id(ids: TensorSpec) -> int | None:
    """Returns the highest id of a spec, or None if it allows whatever its type can hold."""
    if isinstance(ids, Categorical):
        return int(ids.n) - 1
    if not isinstance(ids, Bounded):
        return None
    highest = int(ids.space.high.cpu().numpy().max())  # PyTorch has no maximum of uint16
    return None if highest == torch.iinfo(ids.dtype).max else highest


def _map_size(maps: Sequence[Tensor | TensorSpec], reads: Sequence[Reads]) -> tuple[int, int]:
    """Returns height and width of the maps."""
    at, like = next((each.shape.index("H"), i) for i, each in enumerate(reads) if "H" in each.shape)
    height, width, *_ = maps[like].shape[at - len(reads[like].shape) :]
    return height, width


def masked_flow(flow: Tensor, key: NestedKey, tensordict: TensorDictBase) -> Tensor:
    """Returns the flow `[*B, 2, H, W]` under a key, nan where the mask beside it is False."""
    known = tensordict.get(mask_key(key), None)
    if known is None:
        return flow
    shape = flow[..., :1, :, :].shape
    if known.is_floating_point() or known.shape != shape:
        raise ValueError(
            f"key {mask_key(key)!r}, the mask of {key!r}, should be bool or whole numbers "
            f"{list(shape)}; got {known.dtype} {list(known.shape)}: convert or rename it"
        )
    known = as_type(known, torch.bool)
    if torch.compiler.is_compiling():
        # As bytes, because inductor's CPU code can't compile a `where` on `RawFlow`'s view as bool.
        known = known.view(torch.uint8) != 0
    return torch.where(known, flow, math.nan)


def mask_key(flow: NestedKey) -> NestedKey:
    """Returns the key of the mask beside a raw flow: `"raw_valid"` for `"raw"`."""
    *path, name = (flow,) if isinstance(flow, str) else flow
    return (*path, f"{name}_valid") if path else f"{name}_valid"


def _scales(scale: float | Mapping[str, float], flows: Sequence[str]) -> dict[str, float]:
    """Returns the factor of each flow; raises ValueError if one is missing, 0 or not finite."""
    scales = scale if isinstance(scale, Mapping) else dict.fromkeys(flows, scale)
    if set(scales) != set(flows):
        raise ValueError(f"scale needs one value for each of {list(flows)}, got {dict(scales)}")
    wanted = "a finite number other than 0"
    return {n: checked_number("scale", scales[n], wanted, lambda x: x != 0) for n in flows}


def as_intrinsics(intrinsics: Tensor | Sequence[Sequence[float]]) -> Tensor:
    """Returns K as a float tensor `[3, 3]`; raises ValueError if it isn't one."""
    K = torch.as_tensor(intrinsics)
    K = K.clone() if K.is_floating_point() else K.to(torch.get_default_dtype())
    if K.shape != (3, 3):
        raise ValueError(
            "intrinsics is K, [3, 3], or the key of K, [*B, 3, 3], in the TensorDict; got "
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
