"""Files of recordings: text, JSON, pictures, arrays, depth maps and flow.

An invalid file raises `SequenceError`, a missing one `OSError`; both name the file.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import re
import struct
from collections.abc import Collection, Iterator, Sequence
from fnmatch import fnmatchcase
from glob import escape
from itertools import chain
from pathlib import Path
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from PIL.Image import DecompressionBombError as _Bomb

from flowrep.extras import require
from flowrep.sequences.recording import SequenceError

DepthCoding: TypeAlias = Literal["float32_rgba"]
FlowMap: TypeAlias = NDArray[np.float32]  # [2, H, W], u right, v down; nan where unknown

PICTURES = (".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".bmp", ".tif", ".tiff", ".npy")
_HDF5 = (".flo5", ".dsp5", ".hdf5", ".h5")  # the first two are Spring's
_SUFFIXES = {
    "picture": PICTURES,
    "map": (".png", ".npy", ".tif", ".tiff", ".pgm", ".pfm", ".exr", ".dpt", *_HDF5),
    "flow": (".flo", ".png", ".npy", ".pfm", *_HDF5),
    "numbers": (".txt", ".csv", ".json", ".cam", ".pincam", *_HDF5),
}
FLO_TAG = 202021.25
KITTI_BOUNDS = (-512.0, 511.984375)  # steps of 1/64 px, 0 at 2^15
_NUMBER = re.compile(r"[-+]?(nan|inf|\.?\d[\d.]*(e[-+]?\d+)?)", re.IGNORECASE)
UNREADABLE = (ValueError, LookupError, TypeError, ArithmeticError, RecursionError, struct.error)
# More is no frame and no table, but a mistake or a bomb: a small file may ask for all memory.
_MOST_BYTES, _MOST_PIXELS = 1 << 30, 100_000_000
_FLO_UNKNOWN, _FLO_LARGEST = 1e10, 1e9  # written for unknown flow; larger values are unknown


def find_files(path: Path, kind: str) -> dict[str, Path]:
    """Returns the files of a pattern by their names (the text for `*`), in the order of numbers.

    A pattern without a suffix finds the files of all suffixes of its kind.
    """
    before, _, after = path.name.partition("*")
    any_suffix = not any(after.lower().endswith(_SUFFIXES[kind]) for kind in _SUFFIXES)
    after = after if any_suffix else _folded(f"*{after}")[1:]
    found: dict[str, Path] = {}
    for file in path.parent.iterdir() if path.parent.is_dir() else ():
        if file.name.startswith(".") or not file.is_file():
            continue
        if any_suffix and file.suffix.lower() not in _SUFFIXES[kind]:
            continue
        stem = file.stem if any_suffix else _folded(file.name)
        if stem.startswith(before) and stem.endswith(after):
            name = stem[len(before) : len(stem) - len(after)]
            if other := found.get(name):
                raise SequenceError(file, f"belongs to the same frame as {other.name}; remove one")
            found[name] = file
    decimals = {name: _decimal(name) for name in found}
    order: Any = decimals.get if all(decimals.values()) else _natural
    return {name: found[name] for name in sorted(found, key=order)}


def _decimal(name: str) -> tuple[int, str] | None:
    # 0.05 comes before 0.1; as floats, 19 digits would lose some.
    match = re.fullmatch(r"([0-9]+)\.?([0-9]*)", name)
    return match and (int(match[1]), match[2])


def _natural(name: str) -> list[int | str]:
    # frame_9 comes before frame_10; texts and numbers alternate, so that all are comparable.
    return [int(x) if i % 2 else x for i, x in enumerate(re.split(r"([0-9]+)", name))]


def with_suffix(path: Path, kind: str) -> Path:
    """Returns a file's path, with the first suffix of its kind that exists if it has none."""
    if path.name.lower().endswith(_SUFFIXES[kind]):
        return path
    paths = [path.with_name(path.name + suffix) for suffix in _SUFFIXES[kind]]
    return next(chain(filter(Path.exists, paths), *map(alike, paths)), path)


def alike(path: Path) -> Iterator[Path]:
    """Yields the files of a name with or without `*`, whose suffix may be in capitals."""
    name = escape(_folded(path.name)).replace("[*]", "*")
    beginning = name.rpartition(".")[0].rstrip("*") + "*"  # for which glob is fast
    return (x for x in path.parent.glob(beginning) if fnmatchcase(_folded(x.name), name))


def _folded(name: str) -> str:
    return Path(name).stem + Path(name).suffix.lower()


def regular(path: Path, most_bytes: float = _MOST_BYTES) -> Path:
    """Returns a file's path, unless it is a pipe, which might never end, or very large."""
    path = path if path.exists() else next(alike(path), path)
    if path.exists() and not path.is_file():
        raise SequenceError(path, "is not a regular file")
    if path.exists() and path.stat().st_size > most_bytes:
        raise SequenceError(path, f"has {path.stat().st_size:,} bytes, at most {most_bytes:,} fit")
    return path


def check_size(path: Path, *size: int) -> None:
    """Raises SequenceError for more pixels than a picture has, before memory is taken for them."""
    if math.prod(size) > _MOST_PIXELS:
        says = " x ".join(map(str, size))
        raise SequenceError(path, f"has {says} pixels or numbers, at most {_MOST_PIXELS:,} fit")


def read_lines(path: Path) -> list[str]:
    """Returns the non-empty lines; `#` starts a comment."""
    lines = map(str.strip, regular(path).read_text("utf-8-sig", errors="replace").splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def read_table(
    path: Path, key: int | None = None, *, named: bool = False
) -> tuple[NDArray[np.float64], Any]:
    """Returns the numbers of a file, a row a line, and what stands in the column `key` instead.

    They are separated by blanks or commas. A first line that begins with a word is a header. If
    rows are `named`, the key is a word, and lines without one, as COLMAP's lines of points, are no
    rows. `file.txt:key` is the line `key: numbers`; for JSON see `read_json`. An array of HDF5 has
    a row for each index of its first axis. Sintel's `.cam` is one row, K and the extrinsics; a pose
    of Open3D's `.log` is four lines after one of other numbers.
    """
    # The name of a file may hold a colon, e.g. a time's.
    file, _, line = (path.name, "", "") if path.exists() else path.name.partition(":")
    suffix, names = Path(file).suffix.lower(), None
    try:
        if suffix == ".json" or suffix in _HDF5:
            array = np.array(read_json(path) if suffix == ".json" else read_array(path), np.float64)
            table = array.reshape(len(array) if array.ndim > 1 else array.size, -1)
        elif suffix == ".cam":
            tag, *row = struct.unpack("<f21d", regular(path).read_bytes())
            table = np.array([row] if tag == FLO_TAG else [])
        else:
            lines = [text.replace(",", " ") for text in read_lines(path.with_name(file))]
            if line:
                lines = [dict(text.partition(":")[::2] for text in lines)[line]]
            elif suffix == ".log":
                lines = [" ".join(lines[i + 1 : i + 5]) for i in range(0, len(lines), 5)]
            rows = [text.split() for text in lines]
            if named and key is not None:
                rows = [x for x in rows if len(x) > key and not _NUMBER.fullmatch(x[key])]
                names = [row.pop(key) for row in rows]
            elif rows and not _NUMBER.fullmatch(rows[0][0]):
                del rows[0]
            table = np.array(rows, np.float64)
        if named and names is None and key is not None:
            raise ValueError("it has no column of names")
        if key is not None and names is None:
            return np.delete(table, key, 1), table[:, key]
    except UNREADABLE as error:
        raise SequenceError(path, f"holds no table of numbers: {error}") from None
    if not table.size:
        raise SequenceError(path, "holds no numbers")
    return table, names


def read_json(path: Path) -> Any:
    """Returns what a JSON holds at the keys of a path `file.json:key.key`.

    `*` is each item of a list or value of an object; at the end, an object's keys.
    """
    name, _, keys = path.name.partition(":")
    path = path.with_name(name)
    try:
        return _found(json.loads(regular(path).read_bytes()), keys.split("."))
    except UNREADABLE as error:
        raise SequenceError(path, f"has nothing at {keys}: {error!r}") from None


def _found(value: Any, steps: list[str]) -> Any:
    if not steps:
        return value
    step, *rest = steps
    if step == "*" and rest:
        return [_found(v, rest) for v in (value.values() if isinstance(value, dict) else value)]
    if step == "*":
        return [*value]
    return _found(value[int(step)] if isinstance(value, list) else value[step], rest)


def read_array(path: Path) -> NDArray[Any]:
    """Returns a picture or an array, `[H, W]` or `[H, W, channels]` with red first."""
    suffix, array = path.suffix.lower(), None
    try:
        if suffix == ".npy":
            # Memory-mapped; otherwise, memory for the size in a broken header would be allocated.
            mapped = np.load(regular(path), mmap_mode="r")
            check_size(path, *mapped.shape)
            array = np.array(mapped) if isinstance(mapped, np.ndarray) else None
        elif suffix in (".flo", ".dpt"):
            data = regular(path).read_bytes()
            tag, width, height = struct.unpack_from("<fii", data)
            if tag == FLO_TAG and min(width, height) > 0:
                values = np.frombuffer(data, "<f4", offset=12).astype(np.float32)
                array = values.reshape(height, width, 2 if suffix == ".flo" else 1)
        elif suffix == ".exr":
            array = _read_exr(path)
        elif suffix in _HDF5:
            array = _read_hdf5(path)
        else:
            array = decoded(path, regular(path).read_bytes())
    except (ValueError, EOFError, RuntimeError, struct.error, cv2.error, _Bomb) as error:
        raise SequenceError(path, f"can't be read as {suffix}: {error}") from None
    if array is None:
        raise SequenceError(path, f"is no {suffix} file, or was cut off")
    return array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array


def decoded(path: Path, data: bytes) -> NDArray[Any]:
    """Returns the picture in a file's bytes, red first; ValueError for none or a part of one."""
    # Before version 5, OpenCV silently fills a truncated picture with grey, so look for the end
    # marker. Some cameras write a few bytes after it.
    end = {b"\x89P": b"IEND", b"\xff\xd8": b"\xff\xd9"}.get(data[:2], b"")
    if not data or end not in data[-4096:]:
        raise ValueError("it is no picture, or was cut off")
    with contextlib.suppress(UnidentifiedImageError):  # OpenCV reads more kinds, e.g. .pfm
        check_size(path, *Image.open(io.BytesIO(data)).size)
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise ValueError("OpenCV can't decode it")
    if picture.ndim == 2:
        return picture
    return picture[..., [2, 1, 0, 3][: picture.shape[2]]]


def _read_exr(path: Path) -> NDArray[Any]:
    """Returns a channel: of those of depth if one's name says so, the first of Z, R, Y and V."""
    require("reading .exr", "exr", "OpenEXR")
    import OpenEXR

    window = OpenEXR.File(str(regular(path)), header_only=True).header()["dataWindow"]
    check_size(path, *(int(last) - int(first) + 1 for first, last in zip(*window)))
    planes = OpenEXR.File(str(regular(path)), separate_channels=True).channels()
    # Renderers put a layer's name before it: Blender's files may hold Image.R and Depth.V.
    order = {x: ("depth" not in x.lower(), f"ZRYV{x[-1]}".index(x[-1]), x) for x in planes}
    name = min(planes, key=order.__getitem__)
    pixels: NDArray[Any] = planes[name].pixels
    return pixels


def _read_hdf5(path: Path) -> NDArray[Any]:
    """Returns the only array of a file."""
    require(f"reading {path.suffix}", "hdf5", "h5py")
    import h5py

    arrays: dict[str, Any] = {}
    try:
        with h5py.File(regular(path)) as file:
            file.visititems(lambda name, x: arrays.update({name: x} if hasattr(x, "shape") else {}))
            if len(arrays) != 1:
                raise SequenceError(path, f"holds {len(arrays)} arrays, not one: {[*arrays][:8]}")
            (stored,) = arrays.values()
            check_size(path, *stored.shape)
            return np.array(stored)
    except OSError as error:  # which doesn't name the file
        raise SequenceError(path, f"can't be read as HDF5: {error}") from None


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Returns a colour picture `[H, W, 3]`; a grey one has three equal channels."""
    picture = read_array(path)
    if picture.dtype != np.uint8:
        raise SequenceError(path, f"has {8 * picture.itemsize} bits per channel, colour has 8")
    colours = picture[..., :3] if picture.ndim == 3 else np.stack(3 * [picture], -1)
    return np.ascontiguousarray(colours)


def read_depth(
    path: Path,
    unit_m: float | None = None,
    missing: Collection[int] = (0, 65535),
    no_surface: int | None = None,
    coding: DepthCoding | None = None,
) -> NDArray[np.float32]:
    """Returns stored depth `[H, W]` in metres: nan where missing, inf where there is no surface.

    Args:
        unit_m: metres of a stored 1; None is 0.001 for whole numbers and 1 for floats.
        missing: whole numbers that mean missing depth.
        no_surface: the whole number that means no surface.
        coding: of colour pictures: `"float32_rgba"`, a float whose bytes are blue, green, red and
            alpha (TartanAir V2).
    """
    stored, usual_m = stored_depth(path, coding)
    depth = (stored * np.float64(usual_m if unit_m is None else unit_m)).astype(np.float32)
    if stored.dtype.kind != "f":
        depth[np.isin(stored, list(missing))] = np.nan
        if no_surface is not None:
            depth[stored == no_surface] = np.inf
    return depth


def stored_depth(path: Path, coding: DepthCoding | None = None) -> tuple[NDArray[Any], float]:
    """Returns the numbers `[H, W]` that a file stores, and the usual metres of a 1."""
    stored = read_array(path)
    if coding == "float32_rgba" and stored.dtype == np.uint8 and stored.shape[2:] == (4,):
        stored = np.ascontiguousarray(stored[..., [2, 1, 0, 3]]).view("<f4")[..., 0]
    is_whole = stored.dtype.kind in "ui" and stored.itemsize > 1
    if stored.ndim != 2 or not (is_whole or stored.dtype.kind == "f"):
        given = f"holds {stored.dtype} {list(stored.shape)}"
        wanted = "one channel of 16 bits or floats" if coding is None else f"depth_coding={coding}"
        raise SequenceError(path, f"{given}, expected {wanted}")
    return stored, 0.001 if is_whole else 1.0


def read_flow(
    path: Path,
    bounds: Literal["size"] | Sequence[float] = KITTI_BOUNDS,
    marks_unknown: bool = True,
) -> FlowMap:
    """Returns the first two channels of a file as flow `[2, H, W]`, nan where unknown.

    Args:
        bounds: of a PNG: the flow of the codes 0 and 65535, pixels; `"size"`, of u minus and plus
            the width - 1, of v the height - 1.
        marks_unknown: of a PNG: whether the third channel is 0 where flow is unknown.
    """
    stored, is_coded = read_array(path), path.suffix.lower() == ".png"
    is_right = stored.dtype == np.uint16 if is_coded else stored.dtype.kind == "f"
    if not is_right or stored.shape[2:] not in ((2,), (3,)):
        says = f"holds {stored.dtype} {list(stored.shape)}, expected floats [height, width, 2]"
        raise SequenceError(path, f"{says}, or a PNG of three channels of 16 bits")
    flow = stored[..., :2].transpose(2, 0, 1).astype(np.float32)
    if path.suffix.lower() == ".flo":
        flow[:, ~(np.abs(flow).max(0) <= _FLO_LARGEST)] = np.nan  # nan compares False
    if is_coded:
        most = np.array(stored.shape[1::-1])[:, None, None] - 1.0  # width, height
        low, high = (-most, most) if bounds == "size" else map(np.float64, bounds)
        flow = (low + flow * ((high - low) / 65535)).astype(np.float32)
        if marks_unknown:
            flow[:, stored[..., 2] == 0] = np.nan
    return flow


def write_flo(path: Path, flow: FlowMap, valid: NDArray[np.bool_] | None = None) -> None:
    """Writes flow `[2, H, W]`; invalid pixels get the format's value for unknown flow."""
    _, height, width = flow.shape
    known = np.isfinite(flow).all(0) & (valid is None or valid)
    marked = np.where(known, flow, np.float32(_FLO_UNKNOWN)).transpose(1, 2, 0)
    header = struct.pack("<fii", FLO_TAG, width, height)
    path.write_bytes(header + marked.astype("<f4").tobytes())


def write_kitti_flow(path: Path, flow: FlowMap) -> None:
    """Writes flow `[2, H, W]` in steps of 1/64 px; flow beyond 512 px is marked as unknown."""
    known = np.isfinite(flow).all(0)
    steps = np.rint(np.where(known, flow, 0.0) * 64) + 2**15
    known &= ((steps >= 0) & (steps < 2**16)).all(0)
    coded = np.where(known, steps, 0).astype(np.uint16)
    write_picture(path, np.stack([coded[0], coded[1], known.astype(np.uint16)], -1))


def write_picture(path: Path, image: NDArray[Any]) -> None:
    """Writes a picture `[H, W]` or `[H, W, 3]` as a PNG, with fast rather than good compression."""
    # Not imwrite, which doesn't report a full disk.
    blue_green_red = image if image.ndim == 2 else image[..., ::-1]
    data = cv2.imencode(".png", blue_green_red, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    path.write_bytes(data.tobytes())
