"""Base classes of transforms that write optical flow: intrinsics, outputs and units."""

from __future__ import annotations

import math
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Categorical, TensorSpec, Unbounded

from flowrep.geometry import check_intrinsics
from flowrep.transforms.base import DEPTH, Keys, MapTransform, Reads, as_keys

UNITS = ("px_per_step", "px_per_s")

CAMERA = Reads((3, 3), "float")

# K itself, or the key under which the env gives it.
Intrinsics: TypeAlias = Tensor | Sequence[Sequence[float]] | NestedKey


class CameraTransform(MapTransform):
    """Holds K in its original float type, even if the transform is cast to another.

    Args:
        intrinsics: K `[3, 3]`, its key in the TensorDict, where it is `[*B, 3, 3]`, or None if K
            isn't needed. A key is read after all other keys.
        reads: see `MapTransform`.
        in_keys: see `MapTransform`.
        out_keys: see `MapTransform`.

    Raises:
        ValueError: for a K that is not finite, not positive in fx and fy, or transposed.
    """

    K: Tensor | None

    def __init__(
        self,
        intrinsics: Intrinsics | None,
        reads: Sequence[Reads],
        in_keys: Keys,
        out_keys: Keys,
    ) -> None:
        key = None if intrinsics is None else intrinsics_key(intrinsics)
        camera: list[NestedKey] = [] if key is None else [key]
        super().__init__([*reads, *[CAMERA] * len(camera)], [*as_keys(in_keys), *camera], out_keys)
        given = intrinsics is not None and key is None
        self.register_buffer("K", as_intrinsics(intrinsics) if given else None, persistent=False)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> CameraTransform:
        """Moves K between devices but keeps its type, as bfloat16 would round 319.5 px to 320."""
        exact = self.K
        super()._apply(fn, recurse)
        if exact is not None and self.K is not None:
            self.K = exact.to(self.K.device)
        return self


class FlowTransform(CameraTransform):
    """Base of flow transforms, with the intrinsics K, the chosen outputs and their unit.

    Args:
        intrinsics: K `[3, 3]` of the input maps, in pixels, or its key in the TensorDict, where it
            is `[*B, 3, 3]`; a key is read after all other keys. None if K isn't needed.
        reads: see `MapTransform`.
        outputs: which of the class's outputs to write, in this order.
        scale: factor on every flow, or one per output.
        unit: `"px_per_step"` or `"px_per_s"`.
        dt_s: duration of a step in seconds; needed only for `"px_per_s"`.
        compiled: whether `compute` runs through `torch.compile`.
        in_keys: see `MapTransform`.
        out_keys: one key per output.
        masked: outputs beside which the class writes where they are known, under `mask_key`.

    Raises:
        ValueError: for a number of keys, a unit or a `dt_s` that does not fit, and for
            `compiled=True` on a machine without a C++ compiler.
    """

    def __init__(
        self,
        intrinsics: Intrinsics | None,
        reads: Sequence[Reads],
        *,
        outputs: Sequence[str],
        scale: float | Mapping[str, float],
        unit: str | Mapping[str, str],
        dt_s: float | None,
        compiled: bool,
        in_keys: Keys,
        out_keys: Keys | None,
        masked: Sequence[str] = (),
    ) -> None:
        super().__init__(
            intrinsics, reads, in_keys, list(outputs) if out_keys is None else out_keys
        )
        if len(self.out_keys) != len(outputs):
            raise ValueError(
                f"{type(self).__name__} writes {list(outputs)}: out_keys needs as many keys, "
                f"got {self.out_keys}"
            )
        self.outputs = tuple(outputs)
        keys = zip(outputs, tuple(self.out_keys))
        self.masks = tuple(mask_key(key) for name, key in keys if name in masked)
        self.out_keys = [*self.out_keys, *self.masks]
        flows = [output for output in outputs if output != "valid"]
        scales = _per_output("scale", scale, flows)
        units = _per_output("unit", unit, flows)
        self.is_per_second = "px_per_s" in units.values()
        self.factors = {name: _factor(scales[name], units[name], dt_s) for name in flows}
        if compiled:
            _check_compiler()
        self.compiled = bool(compiled)

    def _with_camera(self, maps: Sequence[Tensor]) -> tuple[list[Tensor], Tensor]:
        """Returns the maps and K, which is the last of them if it is read from a key."""
        return ([*maps], self.K) if self.K is not None else ([*maps[:-1]], maps[-1])

    def _in_unit(self, name: str, flow: Tensor) -> Tensor:
        factor = self.factors[name]
        return flow if factor == 1.0 else flow * factor

    def _at_one_precision(self, *maps: Tensor, depth: Tensor, K: Tensor) -> list[Tensor]:
        """Returns the maps, depth and K in depth's float type, at least float32.

        Raw and ego flow have to round alike; otherwise obj would be rounding noise on static
        pixels.
        """
        dtype = torch.promote_types(depth.dtype, torch.float32)
        return [tensor.to(dtype) for tensor in (*maps, depth, K)]

    def output_specs(self, *specs: TensorSpec) -> tuple[TensorSpec, ...]:
        """Returns an unbounded spec per flow and a boolean one for the mask."""
        depth = next(spec for spec, reads in zip(specs, self.reads) if reads == DEPTH)
        batch, size, device = depth.shape[:-3], depth.shape[-2:], depth.device
        dtype = torch.promote_types(depth.dtype, torch.float32)
        return tuple(
            mask_spec(batch, size, device)
            if name == "valid"
            else Unbounded((*batch, 2, *size), device=device, dtype=dtype)
            for name in (*self.outputs, *["valid"] * len(self.masks))
        )


def mask_spec(batch: torch.Size, size: torch.Size, device: torch.device | None) -> TensorSpec:
    """Returns the spec of a mask, bool `[*B, 1, H, W]`."""
    return Categorical(2, shape=(*batch, 1, *size), device=device, dtype=torch.bool)


def mask_key(flow: NestedKey) -> NestedKey:
    """Returns the key of the mask that says where a raw flow is known: `"raw_valid"` for `"raw"`."""
    *path, name = (flow,) if isinstance(flow, str) else flow
    return (*path, f"{name}_valid") if path else f"{name}_valid"


def checked_outputs(outputs: Sequence[str], known: tuple[str, ...]) -> tuple[str, ...]:
    """Returns the outputs as a tuple; raises ValueError if one is unknown or named twice."""
    unknown = [name for name in outputs if name not in known]
    if isinstance(outputs, str) or unknown or not outputs or len(set(outputs)) != len(outputs):
        raise ValueError(
            f"outputs must be a list with some of {list(known)}, each once; got {outputs!r}"
        )
    return tuple(outputs)


def _per_output(option: str, value: object, flows: Sequence[str]) -> dict[str, object]:
    if not isinstance(value, Mapping):
        return dict.fromkeys(flows, value)
    if set(value) != set(flows):
        raise ValueError(f"{option} needs one value for each of {list(flows)}, got {dict(value)}")
    return dict(value)


def _factor(scale: object, unit: object, dt_s: float | None) -> float:
    if unit not in UNITS:
        raise ValueError(f"unit must be one of {list(UNITS)}, got {unit!r}")
    factor = float(scale)  # type: ignore[arg-type]
    if not math.isfinite(factor) or factor == 0.0:
        raise ValueError(f"scale must be a finite number other than 0, got {scale}")
    if unit == "px_per_step":
        return factor
    if dt_s is None or not dt_s > 0:
        raise ValueError(f"unit 'px_per_s' needs dt_s, the seconds that a step lasts; got {dt_s}")
    return factor / dt_s


def intrinsics_key(intrinsics: Intrinsics) -> NestedKey | None:
    """Returns the key of the intrinsics, or None if they are K itself."""
    if isinstance(intrinsics, str):
        return intrinsics
    if isinstance(intrinsics, (tuple, list)) and all(isinstance(part, str) for part in intrinsics):
        return tuple(intrinsics)
    return None


def as_intrinsics(intrinsics: Intrinsics) -> Tensor:
    """Returns K as a float tensor `[3, 3]`; raises ValueError if it is none."""
    K = torch.as_tensor(intrinsics)
    K = K.clone() if K.is_floating_point() else K.to(torch.get_default_dtype())
    if K.shape != (3, 3):
        raise ValueError(
            f"intrinsics is K, [3, 3], or the key of [*B, 3, 3] in the TensorDict; got "
            f"{list(K.shape)}"
        )
    check_intrinsics("intrinsics", K)
    return K


def _check_compiler() -> None:
    """Raises ValueError if the C++ compiler that `torch.compile` calls is not installed."""
    compiler = os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++")
    if sys.platform != "win32" and shutil.which(compiler) is None:
        raise ValueError(
            f"compiled=True needs a C++ compiler, and {compiler} is not on PATH: install it, name "
            "another one in the environment variable CXX, or set compiled=False"
        )
