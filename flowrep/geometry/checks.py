"""Checks of arguments. Compiled code skips those of shapes and dtypes, which are static."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, get_args

import torch
from torch import Tensor


def check_shape(
    name: str, tensor: Tensor, trailing: tuple[int | str, ...], *, ids: bool = False
) -> None:
    """Checks that `tensor` holds floats (integers if `ids`) and that its last dims are `trailing`.

    In `trailing`, a string is the name of a dim of any size. Raises TypeError or ValueError.
    """
    if not isinstance(tensor, Tensor):
        raise TypeError(
            f"{name} must be a torch.Tensor, got {type(tensor).__name__}; "
            "wrap it with torch.as_tensor"
        )
    if ids and (tensor.is_floating_point() or tensor.is_complex() or tensor.dtype is torch.bool):
        raise TypeError(f"{name} must hold integer ids, got {tensor.dtype}")
    if not ids and not tensor.is_floating_point():
        raise TypeError(
            f"{name} must be floating point (metres, pixels), got {tensor.dtype}; "
            "convert it first, e.g. millimetres with `depth.float() / 1000`"
        )
    fits = tensor.ndim >= len(trailing) and all(
        isinstance(want, str) or got == want
        for got, want in zip(tensor.shape[tensor.ndim - len(trailing) :], trailing)
    )
    if not fits:
        wanted = ", ".join(["*B", *(str(size) for size in trailing)])
        raise ValueError(f"{name} must be [{wanted}], got {list(tensor.shape)}")


def common_batch(**batches: torch.Size) -> torch.Size:
    """Returns the common leading batch of several arguments; ValueError lists each one's."""
    first, *others = batches.values()
    if all(batch == first for batch in others):
        return first
    try:
        return torch.broadcast_shapes(*batches.values())
    except RuntimeError as error:
        listing = ", ".join(f"{name} {list(batch)}" for name, batch in batches.items())
        raise ValueError(
            f"leading batch dims do not broadcast: {listing}; give each the same batch, or none"
        ) from error


def over_points(name: str, matrix: Tensor, points_name: str, points: Tensor) -> Tensor:
    """Returns matrices `[*B, r, c]` that broadcast with points `[*B, ..., 3]`."""
    batch = matrix.shape[:-2]
    point_dims = points.ndim - 1 - len(batch)
    if point_dims < 0:
        raise ValueError(
            f"{name} has batch {list(batch)}, which {points_name} {list(points.shape)} lacks; "
            f"its batch dims are the leading dims of {points_name}"
        )
    common_batch(**{name: batch, points_name: points.shape[: len(batch)]})
    return matrix.reshape(*batch, *[1] * point_dims, *matrix.shape[-2:])


def first_wrong(name: str, wrong: Tensor) -> tuple[str, tuple[int, ...]]:
    """Returns the name and the index of the first wrong item of a batch."""
    index = wrong.nonzero()[0].tolist()
    return (f"{name}[{', '.join(map(str, index))}]" if index else name), tuple(index)


def check_name(option: str, name: object, names: Any) -> None:
    """Raises ValueError if `name` is not a value of the `Literal` `names`, and lists its values."""
    known = list(get_args(names))
    if name not in known:
        raise ValueError(f"{option} must be one of {known}, got {name!r}")


def checked_count(option: str, count: float, least: int = 1, most: int | None = None) -> int:
    """Returns a whole number as an int; raises ValueError for a fraction, or one out of range."""
    number = _as_float(count)
    if number % 1 != 0 or number < least or (most is not None and number > most):  # nan % 1 is nan
        limits = f"of at least {least}" if most is None else f"from {least} to {most}"
        raise ValueError(f"{option} must be a whole number {limits}, got {count!r}")
    return int(count)


def checked_number(option: str, number: Any, wanted: str, fits: Callable[[float], bool]) -> float:
    """Returns a finite number that `fits` as a float; raises ValueError with what was `wanted`."""
    value = _as_float(number)
    if not (math.isfinite(value) and fits(value)):
        raise ValueError(f"{option} must be {wanted}, got {number!r}")
    return value


def _as_float(value: Any) -> float:
    """Returns a number as a float, nan for anything else; a number in quotes is a mistake."""
    try:
        return math.nan if isinstance(value, str) else float(value)
    except (ArithmeticError, RuntimeError, TypeError, ValueError):  # a tensor raises RuntimeError
        return math.nan


def check_rows(lowest: int, highest: int, rows: int) -> None:
    """Raises RuntimeError if some id from `lowest` to `highest` has no row among `rows` motions."""
    if lowest < 0 or highest >= rows:
        raise RuntimeError(
            f"instance holds ids {lowest} to {highest}, but prev_from_curr_by_instance has {rows} "
            f"rows, for ids 0 to {rows - 1}; convert a simulator's ids, such as -1 for the "
            "background, with the transform InstanceIds or with flowrep.geometry.instance_rows"
        )
