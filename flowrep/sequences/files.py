"""Files of recordings: text, pictures, arrays, depth maps and flow.

What is invalid raises `SequenceError`, which names the file; what is missing, `OSError`, which does
so too.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.recording import SequenceError

PICTURES = (".png", ".jpg", ".jpeg")
DEPTH_FILES = (".png", ".npy")
FLO_TAG = 202021.25
_FLO_UNKNOWN, _FLO_LARGEST = 1e10, 1e9  # what is written for unknown flow, and what is not read

Flow = NDArray[np.float32]  # [2, H, W], u right, v down; nan where unknown


def list_files(folder: Path, suffixes: Sequence[str], prefix: str = "") -> list[Path]:
    """Returns a folder's files with one of the suffixes, sorted by number, then by name."""
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes]
    found = [path for path in found if path.name.startswith(prefix)]
    if not found:
        raise SequenceError(folder, f"holds no {prefix}*{' or '.join(suffixes)} file")
    found.sort(key=_natural)
    for first, second in pairwise(found):
        if first.stem == second.stem:
            raise SequenceError(second, f"belongs to the same frame as {first.name}; remove one")
    return found


def _natural(path: Path) -> tuple[list[int | str], str]:
    # frame_9 comes before frame_10; texts and numbers take turns, so all are comparable
    pieces = re.split(r"([0-9]+)", path.stem)
    return [int(piece) if piece.isdecimal() else piece for piece in pieces], path.name


def read_lines(path: Path) -> list[str]:
    """Returns the non-empty lines; `#` starts a comment."""
    lines = map(str.strip, path.read_text("utf-8", errors="replace").splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def read_table(path: Path, *columns: int, header: bool = False) -> NDArray[np.float64]:
    """Returns the numbers of a text file, with one of the permitted numbers of `columns`."""
    # Separated by blanks or commas.
    lines = [line.replace(",", " ") for line in read_lines(path)[int(header) :]]
    if not lines:
        raise SequenceError(path, "holds no numbers")
    try:
        table = np.loadtxt(lines, ndmin=2)
    except ValueError as error:
        raise SequenceError(path, str(error)) from None
    width = table.shape[1]
    if width not in columns:
        expected = " or ".join(map(str, columns))
        raise SequenceError(path, f"has {width} numbers in a line, expected {expected}")
    return table


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Returns a colour picture `[H, W, 3]`; a grey one has three equal channels."""
    picture = _decode(path)
    if picture.dtype != np.uint8:
        raise SequenceError(path, f"has {8 * picture.itemsize} bits per channel, colour has 8")
    blue_green_red = picture[..., :3] if picture.ndim == 3 else np.stack(3 * [picture], -1)
    return np.ascontiguousarray(blue_green_red[..., ::-1])


def read_png(path: Path, dtype: type, channels: int = 1) -> NDArray[Any]:
    """Returns a picture of a given type, `[H, W]`, or `[H, W, channels]` with red first."""
    picture = _decode(path)
    found = 1 if picture.ndim == 2 else picture.shape[2]
    if picture.dtype != dtype or found != channels:
        expected = f"{channels} of {8 * np.dtype(dtype).itemsize}"
        raise SequenceError(
            path, f"has {found} channels of {8 * picture.itemsize} bits, expected {expected}"
        )
    return picture if channels == 1 else picture[..., ::-1]


def _decode(path: Path) -> NDArray[Any]:
    data = path.read_bytes()
    # OpenCV fills up a picture that was cut off with grey and says nothing, so look for its end.
    # Some cameras write a few bytes after it.
    whole = b"IEND" in data[-4096:] or (data[:2] == b"\xff\xd8" and b"\xff\xd9" in data[-4096:])
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if whole else None
    if picture is None:
        raise SequenceError(path, "is no PNG or JPEG, or was cut off")
    return picture


def read_npy(path: Path, dims: int = 2) -> NDArray[Any]:
    """Returns an array with a number of dimensions."""
    try:
        array: NDArray[Any] = np.load(path)
    except (ValueError, EOFError) as error:
        raise SequenceError(path, f"is no whole .npy file ({error})") from None
    if array.ndim != dims:
        raise SequenceError(path, f"holds an array {list(array.shape)}, expected {dims} dimensions")
    return array


def depth_from_integers(
    values: NDArray[np.uint16],
    unit_m: float,
    *,
    missing: Iterable[int] = (),
    no_surface: int | None = None,
) -> NDArray[np.float32]:
    """Returns depth in metres: nan for the values that mean "missing", inf for "no surface".

    >>> stored = np.array([[0, 1500, 65535]], np.uint16)
    >>> depth_from_integers(stored, 0.001, missing=(0, 65535))
    array([[nan, 1.5, nan]], dtype=float32)
    """
    depth = (values * np.float64(unit_m)).astype(np.float32)
    depth[np.isin(values, list(missing))] = np.nan
    if no_surface is not None:
        depth[values == no_surface] = np.inf
    return depth


def read_depth(
    path: Path, size: tuple[int, int], unit_m: float | None = None
) -> NDArray[np.float32]:
    """Returns the depth of a .png (0 and 65535 are missing) or .npy, of the given size, in metres.

    A stored 1 is `unit_m` long; None is a millimetre in a .png and a metre in a .npy.
    """
    if path.suffix.lower() == ".npy":
        depth = read_npy(path)
        if depth.dtype.kind != "f":
            raise SequenceError(path, f"holds {depth.dtype}, expected floats")
        depth = (depth * np.float64(1.0 if unit_m is None else unit_m)).astype(np.float32)
    else:
        unit_m = 0.001 if unit_m is None else unit_m
        depth = depth_from_integers(read_png(path, np.uint16), unit_m, missing=(0, 65535))
    if depth.shape != size:
        (height, width), (own_height, own_width) = size, depth.shape
        raise SequenceError(
            path, f"is {own_width} x {own_height}, intrinsics.json says {width} x {height}"
        )
    return depth


def read_flo(path: Path) -> Flow:
    """Returns a .flo file's flow `[2, H, W]`, nan where unknown."""
    flow = read_tagged_floats(path, channels=2).transpose(2, 0, 1)
    known = np.abs(flow).max(0) <= _FLO_LARGEST  # nan compares False
    return np.where(known, flow, np.float32(np.nan))


def read_tagged_floats(path: Path, channels: int) -> NDArray[np.float32]:
    """Returns the floats of a .flo file or of Sintel's .dpt, `[H, W, channels]`."""
    data = path.read_bytes()
    if len(data) >= 12:
        tag, width, height = struct.unpack_from("<fii", data)
        if tag == FLO_TAG and len(data) == 12 + 4 * channels * width * height:
            values = np.frombuffer(data, "<f4", offset=12).astype(np.float32)
            return values.reshape(height, width, channels)
    raise SequenceError(path, f"is not {FLO_TAG}, width, height and {channels} floats a pixel")


def write_flo(path: Path, flow: Flow, valid: NDArray[np.bool_] | None = None) -> None:
    """Writes flow `[2, H, W]`; invalid pixels get the format's mark for unknown."""
    _, height, width = flow.shape
    known = np.isfinite(flow).all(0) & (valid is None or valid)
    marked = np.where(known, flow, np.float32(_FLO_UNKNOWN)).transpose(1, 2, 0)
    header = struct.pack("<fii", FLO_TAG, width, height)
    path.write_bytes(header + marked.astype("<f4").tobytes())


def read_kitti_flow(path: Path) -> Flow:
    """Returns the flow `[2, H, W]` of a KITTI PNG, nan where its third channel is 0."""
    u, v, valid = read_png(path, np.uint16, 3).transpose(2, 0, 1)
    flow = (np.stack([u, v]).astype(np.float32) - 2**15) / 64
    flow[:, valid == 0] = np.nan
    return flow.astype(np.float32, copy=False)


def write_kitti_flow(path: Path, flow: Flow, valid: NDArray[np.bool_] | None = None) -> None:
    """Writes flow `[2, H, W]` in steps of 1/64 px; beyond 512 px it is marked as unknown."""
    known = np.isfinite(flow).all(0) & (valid is None or valid)
    steps = np.rint(np.where(known, flow, 0.0) * 64) + 2**15
    known &= ((steps >= 0) & (steps < 2**16)).all(0)
    coded = np.where(known, steps, 0).astype(np.uint16)
    write_picture(path, np.stack([coded[0], coded[1], known.astype(np.uint16)], -1))


def write_picture(path: Path, image: NDArray[Any]) -> None:
    """Writes a picture `[H, W, 3]` as a PNG with fast rather than strong compression."""
    # Not imwrite, which says nothing of a full disk.
    data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    path.write_bytes(data.tobytes())
