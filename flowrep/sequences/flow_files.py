"""Flow in the file formats of the benchmarks: Middlebury's .flo and KITTI's 16-bit PNG."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.files import read_bytes
from flowrep.sequences.frame import SequenceError
from flowrep.sequences.pictures import check_pixels, read_png16_rgb

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
