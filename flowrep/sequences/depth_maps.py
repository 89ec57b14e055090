"""Converts stored depth maps into metres with nan for missing."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.arrays import read_npy
from flowrep.sequences.frame import SequenceError
from flowrep.sequences.pictures import read_png16

DEPTH_FILES = (".png", ".npy")


def depth_from_integers(
    values: NDArray[np.uint16],
    unit_m: float,
    *,
    missing: Iterable[int] = (),
    no_surface: int | None = None,
) -> NDArray[np.float32]:
    """Returns depth in metres.

    Args:
        values: `[H, W]`, as stored.
        unit_m: the length of a stored 1, metres.
        missing: values that mean "not measured", which become nan.
        no_surface: the value that means "no surface", which becomes inf.

    >>> stored = np.array([[0, 1500, 65535]], np.uint16)
    >>> depth_from_integers(stored, 0.001, missing=(0, 65535))
    array([[nan, 1.5, nan]], dtype=float32)
    """
    depth = (values * np.float64(unit_m)).astype(np.float32)
    for value in missing:
        depth[values == value] = np.nan
    if no_surface is not None:
        depth[values == no_surface] = np.inf
    return depth


def read_depth(path: Path, unit_m: float, size: tuple[int, int]) -> NDArray[np.float32]:
    """Returns a depth map in metres: 16 bits (0 and 65535 missing) times a unit, or floats.

    Args:
        path: a .png, or a .npy of float metres, in which nan is missing and inf no surface.
        unit_m: the unit of the .png, metres.
        size: height and width of its camera's pictures, from intrinsics.json.

    Raises:
        SequenceError: it can't be read, or has another size.
    """
    if path.suffix.lower() == ".npy":
        depth = read_npy(path)
    else:
        depth = depth_from_integers(read_png16(path), unit_m, missing=(0, 65535))
    if depth.shape != size:
        (height, width), (own_height, own_width) = size, depth.shape
        raise SequenceError(
            path, f"is {own_width} x {own_height}, intrinsics.json says {width} x {height}"
        )
    return depth
