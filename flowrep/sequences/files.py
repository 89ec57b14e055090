"""Files of recordings: text, pictures, arrays, depth maps and flow; every error names its file."""

from __future__ import annotations

import io
import json
import math
import os
import re
import struct
import threading
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from flowrep.sequences.recording import SequenceError

MAX_TEXT_BYTES = 64 * 2**20
MAX_FILE_BYTES = 512 * 2**20
_MAX_PATH = 1000


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """Returns a file's content.

    Raises:
        SequenceError: there is no such file, it is empty, or larger than `limit`.
    """
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise SequenceError(path, "is not a file")
        if size > limit:
            raise SequenceError(path, f"has {size:,} bytes, more than the {limit:,} expected here")
        data = path.read_bytes()
    except OSError as error:
        raise SequenceError(path, _reason(error)) from None
    if not data:
        raise SequenceError(path, "is empty")
    return data


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Returns the non-empty lines, each after its number; `#` starts a comment."""
    try:
        text = read_bytes(path, MAX_TEXT_BYTES).decode("utf-8")
    except UnicodeDecodeError:
        raise SequenceError(path, "is not text") from None
    lines = ((number, line.strip()) for number, line in enumerate(text.splitlines(), start=1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def read_table(path: Path, columns: Iterable[int], *, header: bool = False) -> NDArray[np.float64]:
    """Returns the numbers of a text file, one row per line, `[N, columns]`.

    Args:
        path: the file; numbers are separated by blanks or commas.
        columns: the permitted numbers of columns; every line has the same one.
        header: whether the first line has names.

    Raises:
        SequenceError: there are no numbers, or a line has another number of columns.
    """
    allowed = tuple(columns)
    rows: list[list[float]] = []
    for number, line in read_lines(path)[1 if header else 0 :]:
        row = [_number(path, number, word) for word in re.split(r"[\s,]+", line.strip(","))]
        wanted = (len(rows[0]),) if rows else allowed
        if len(row) not in wanted:
            expected = " or ".join(map(str, wanted))
            raise SequenceError(path, f"line {number} has {len(row)} numbers, expected {expected}")
        rows.append(row)
    if not rows:
        raise SequenceError(path, "holds no numbers")
    return np.array(rows, dtype=np.float64)


def read_matrix(path: Path, rows: int, columns: int) -> NDArray[np.float64]:
    """Returns the one matrix that a text file holds."""
    table = read_table(path, [columns])
    if len(table) != rows:
        raise SequenceError(path, f"has {len(table)} lines, expected {rows}")
    return table


def read_json(path: Path) -> dict[str, Any]:
    """Returns the object that a JSON file holds."""
    try:
        value = json.loads(read_bytes(path, MAX_TEXT_BYTES))
    except (ValueError, RecursionError) as error:
        raise SequenceError(path, f"is not JSON ({str(error).splitlines()[0]})") from None
    if not isinstance(value, dict):
        raise SequenceError(path, f"should be a JSON object, not {type(value).__name__}")
    return value


def list_files(folder: Path, suffixes: Iterable[str], prefix: str = "") -> list[Path]:
    """Returns a folder's files with one of the suffixes, sorted by number, then by name.

    Raises:
        SequenceError: no such folder, no such file in it, or two that differ in the suffix alone.
    """
    suffixes = tuple(suffixes)
    try:
        found = [
            path
            for path in folder.iterdir()
            if path.suffix.lower() in suffixes and path.name.startswith(prefix)
        ]
    except OSError as error:
        raise SequenceError(folder, _reason(error, "folder")) from None
    if not found:
        raise SequenceError(folder, f"holds no {prefix}*{' or '.join(suffixes)} file")
    found.sort(key=_natural)
    by_stem: dict[str, Path] = {}
    for path in found:
        if (first := by_stem.setdefault(path.stem, path)) is not path:
            raise SequenceError(path, f"belongs to the same frame as {first.name}; remove one")
    return found


def path_inside(folder: Path, relative: str, index: Path) -> Path:
    """Returns the path that an index file names.

    Raises:
        SequenceError: it leads out of the folder, or is too long for a path.
    """
    if len(relative) > _MAX_PATH:
        raise SequenceError(index, f"names a file by {len(relative):,} characters")
    parts = PurePosixPath(relative.replace("\\", "/"))
    if parts.is_absolute() or ".." in parts.parts or "\0" in relative or ":" in relative:
        raise SequenceError(index, f"names {relative!r}, which lies outside of the folder")
    return folder / parts


def _natural(path: Path) -> tuple[list[tuple[int, int | str]], str]:
    pieces = re.split(r"(\d+)", path.name)
    return [(0, int(p)) if p.isdecimal() and p.isascii() else (1, p) for p in pieces], path.name


def _number(path: Path, line: int, word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise SequenceError(path, f"line {line}: {word[:40]!r} is not a number") from None


def finite_number(path: Path, name: str, value: Any) -> float:
    """Returns a file's value if it is a finite number; otherwise raises SequenceError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SequenceError(path, f"{name} should be a number, not {str(value)[:40]!r}")
    return float(value)


def _reason(error: OSError, what: str = "file") -> str:
    known = {FileNotFoundError: f"no such {what}", NotADirectoryError: "is not a folder"}
    return known.get(type(error), (error.strerror or str(error)).lower())


PICTURES = (".png", ".jpg", ".jpeg")
MAX_PIXELS = 7680 * 4320

_SILENCE = threading.Lock()  # overlapping calls could leave stderr closed
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_JPEG_SIZES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD9)})


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Returns a colour picture `[H, W, 3]`; a grey one has three equal channels.

    Raises:
        SequenceError: the file is not a picture, is damaged, or doesn't have 8 bits per channel.
    """
    picture = _decode(path, cv2.IMREAD_UNCHANGED)
    if picture.dtype != np.uint8:
        raise SequenceError(path, f"has {8 * picture.itemsize} bits a channel, colour has 8")
    if picture.ndim == 2:
        return cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB).astype(np.uint8, copy=False)
    order = cv2.COLOR_BGRA2RGB if picture.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(picture, order).astype(np.uint8, copy=False)


def read_png16(path: Path) -> NDArray[np.uint16]:
    """Returns a 16-bit picture with one channel, `[H, W]`: depth or disparity."""
    picture = _decode(path, cv2.IMREAD_UNCHANGED)
    if picture.dtype != np.uint16 or picture.ndim != 2:
        raise SequenceError(path, f"should have one channel of 16 bits, has {_kind(picture)}")
    return picture


def read_png16_rgb(path: Path) -> NDArray[np.uint16]:
    """Returns a 16-bit picture with three channels, `[H, W, 3]`, red first: flow."""
    picture = _decode(path, cv2.IMREAD_UNCHANGED)
    if picture.dtype != np.uint16 or picture.ndim != 3 or picture.shape[2] != 3:
        raise SequenceError(path, f"should have three channels of 16 bits, has {_kind(picture)}")
    return picture[..., ::-1]


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Returns where an 8-bit grey picture is not black, `[H, W]`."""
    picture = _decode(path, cv2.IMREAD_UNCHANGED)
    if picture.dtype != np.uint8 or picture.ndim != 2:
        raise SequenceError(path, f"should have one channel of 8 bits, has {_kind(picture)}")
    return picture > 0


def check_pixels(path: Path, width: int, height: int) -> None:
    """Raises SequenceError for an impossible size, before memory is allocated for it."""
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise SequenceError(
            path, f"claims {width} x {height} pixels; 1 to {MAX_PIXELS:,} are read (8K)"
        )


def _decode(path: Path, flags: int) -> NDArray:
    data = read_bytes(path)
    if data.startswith(_PNG):
        _check_png(path, data)
    elif data.startswith(_JPEG):
        _check_jpeg(path, data)
    else:
        raise SequenceError(path, "is neither a PNG nor a JPEG")
    try:
        with _native_silence():
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise SequenceError(path, f"can't be decoded ({error.err or error})") from None
    if picture is None:
        raise SequenceError(path, "can't be decoded: its data are corrupt")
    return picture


@contextmanager
def _native_silence() -> Iterator[None]:
    """Keeps libpng and libjpeg from printing about damaged files beside the error.

    They write to file descriptor 2 of the process, not to Python's stderr.
    """
    with _SILENCE:
        try:
            stderr = os.dup(2)
        except OSError:  # it is closed, so nothing is printed
            yield
            return
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            os.close(nowhere)


def _check_png(path: Path, data: bytes) -> None:
    """Walks the chunks, since OpenCV decodes the rest of a truncated picture without an error."""
    place, named = len(_PNG), b""
    while named != b"IEND":
        if place + 12 > len(data):
            raise SequenceError(path, "is a PNG that was cut off")
        length, named = struct.unpack_from(">I4s", data, place)
        end = place + 8 + length
        if end + 4 > len(data):
            raise SequenceError(path, "is a PNG that was cut off")
        if zlib.crc32(memoryview(data)[place + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise SequenceError(path, "is a PNG whose check sums do not fit: its data are corrupt")
        if place == len(_PNG):
            if named != b"IHDR" or length != 13:
                raise SequenceError(path, "is a PNG without a header")
            check_pixels(path, *struct.unpack_from(">II", data, place + 8))
        place = end + 4


def _check_jpeg(path: Path, data: bytes) -> None:
    """Walks the segments to find the size, and looks for the end marker."""
    place = 2
    while True:
        while data[place : place + 2] == b"\xff\xff":
            place += 1
        if place + 9 > len(data) or data[place] != 0xFF:
            raise SequenceError(path, "is a JPEG that was cut off or is corrupt")
        marker = data[place + 1]
        if marker in _JPEG_SIZES:
            height, width = struct.unpack_from(">HH", data, place + 5)
            check_pixels(path, width, height)
            break
        bare = marker in _JPEG_BARE
        place += 2 if bare else 2 + struct.unpack_from(">H", data, place + 2)[0]
    if b"\xff\xd9" not in data[-4096:]:  # some cameras write a few bytes after it
        raise SequenceError(path, "is a JPEG that was cut off")


def _kind(picture: NDArray) -> str:
    channels = 1 if picture.ndim == 2 else picture.shape[2]
    return f"{channels} of {8 * picture.itemsize}"


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


FLO_TAG = 202021.25
FLO_UNKNOWN = 1e10
_FLO_LARGEST = 1e9  # larger values mean unknown in this format

Flow = NDArray[np.float32]  # [2, H, W], u right, v down; nan where unknown


def read_flo(path: Path) -> Flow:
    """Returns a .flo file's flow `[2, H, W]`, nan where unknown.

    Raises:
        SequenceError: it is another file, or not as long as its header says.
    """
    width, height, values = read_tagged_floats(path, channels=2)
    flow = values.reshape(height, width, 2).transpose(2, 0, 1)
    known = np.abs(flow).max(0) <= _FLO_LARGEST  # nan compares False
    return np.where(known, flow, np.float32(np.nan))


def read_tagged_floats(path: Path, channels: int) -> tuple[int, int, NDArray[np.float32]]:
    """Returns width, height and the floats of a .flo file or of Sintel's .dpt."""
    data = read_bytes(path)
    if len(data) < 12 or struct.unpack_from("<f", data)[0] != FLO_TAG:
        raise SequenceError(path, f"does not begin with the number {FLO_TAG}")
    width, height = struct.unpack_from("<ii", data, 4)
    check_pixels(path, width, height)
    expected = 12 + 4 * channels * width * height
    if len(data) != expected:
        raise SequenceError(
            path, f"claims {width} x {height}, {expected:,} bytes, and has {len(data):,}"
        )
    return width, height, np.frombuffer(data, "<f4", offset=12).astype(np.float32)


def write_flo(path: Path, flow: Flow, valid: NDArray[np.bool_] | None = None) -> None:
    """Writes flow `[2, H, W]`; invalid pixels get the format's mark for unknown."""
    _, height, width = flow.shape
    pairs = np.empty((height, width, 2), dtype="<f4")
    pairs[..., 0], pairs[..., 1] = flow
    pairs[~_known(flow, valid)] = FLO_UNKNOWN
    with path.open("wb") as file:
        file.write(struct.pack("<fii", FLO_TAG, width, height))
        file.write(pairs.data)


def read_kitti_flow(path: Path) -> Flow:
    """Returns the flow `[2, H, W]` of a KITTI PNG, nan where its third channel is 0."""
    u, v, valid = read_png16_rgb(path).transpose(2, 0, 1)
    flow = (np.stack([u, v]).astype(np.float32) - 2**15) / 64
    flow[:, valid == 0] = np.nan
    return flow.astype(np.float32, copy=False)


def write_kitti_flow(path: Path, flow: Flow, valid: NDArray[np.bool_] | None = None) -> None:
    """Writes flow `[2, H, W]` in steps of 1/64 px; beyond 512 px it is marked as unknown."""
    known = _known(flow, valid)
    steps = np.rint(np.where(known, flow, 0.0) * 64) + 2**15
    known &= ((steps >= 0) & (steps < 2**16)).all(0)
    coded = np.where(known, steps, 0).astype(np.uint16)
    blue_green_red = np.stack([known.astype(np.uint16), coded[1], coded[0]], -1)
    whole, data = cv2.imencode(".png", blue_green_red, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not whole:
        raise OSError(f"{path}: OpenCV can't encode it")
    path.write_bytes(data.tobytes())


def _known(flow: Flow, valid: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    known: NDArray[np.bool_] = np.isfinite(flow[0]) & np.isfinite(flow[1])
    return known if valid is None else known & valid


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
