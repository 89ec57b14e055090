"""Reads pictures from files with OpenCV; refuses damaged ones and excessive sizes."""

from __future__ import annotations

import os
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.files import read_bytes
from flowrep.sequences.frame import SequenceError

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
