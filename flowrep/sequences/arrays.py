"""Reads arrays of floats from .npy files whose headers may be wrong."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from flowrep.sequences.files import read_bytes
from flowrep.sequences.frame import SequenceError
from flowrep.sequences.pictures import check_pixels


def read_npy(path: Path, *, channels: int | None = None) -> NDArray[np.float32]:
    """Returns an array of floats, `[H, W]`, or `[H, W, channels]` if that is given.

    Raises:
        SequenceError: the file is no .npy file, holds objects or another shape or type, or is
            shorter or longer than its header says.
    """
    return _read(path, channels, ("f",)).astype(np.float32, copy=False)


def read_npy_mask(path: Path) -> NDArray[np.uint8]:
    """Returns an array of bytes `[H, W]`."""
    return _read(path, None, ("u", "b")).astype(np.uint8, copy=False)


def _read(path: Path, channels: int | None, kinds: tuple[str, ...]) -> NDArray[Any]:
    data = read_bytes(path)
    stream = io.BytesIO(data)
    try:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"version {version} is unknown")
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, in_columns, dtype = read_header(stream)
    except Exception as error:  # numpy evaluates the header, which may hold anything
        cause = (str(error).splitlines() or [""])[0][:80]
        raise SequenceError(path, f"has no readable .npy header ({cause})") from None
    if dtype.hasobject or dtype.kind not in kinds:
        raise SequenceError(
            path, f"holds {dtype}, expected {' or '.join(_KINDS[k] for k in kinds)}"
        )
    wanted = 2 if channels is None else 3
    if len(shape) != wanted or (channels is not None and shape[2] != channels):
        expected = "[H, W]" if channels is None else f"[H, W, {channels}]"
        raise SequenceError(path, f"holds an array {list(shape)}, expected {expected}")
    check_pixels(path, shape[1], shape[0])
    claimed, left = math.prod(shape) * dtype.itemsize, len(data) - stream.tell()
    if claimed != left:
        raise SequenceError(path, f"claims {claimed:,} bytes of data and has {left:,}")
    values = np.frombuffer(data, dtype, offset=stream.tell()).copy()
    return values.reshape(shape, order="F" if in_columns else "C")


_KINDS = {"f": "floats", "u": "bytes", "b": "booleans"}
