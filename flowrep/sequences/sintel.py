"""MPI Sintel: rendered film with depth, camera and flow."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.calibration import as_pose
from flowrep.sequences.files import (
    FLO_TAG,
    list_files,
    read_bytes,
    read_flo,
    read_png,
    read_rgb,
    read_tagged_floats,
)
from flowrep.sequences.recording import PLAY_BACKWARDS, Frame, Recording, SequenceError


class Sintel(Recording):
    """One scene of the `training` folder, with depth and camera data unpacked into it.

    Its flow leads from each frame to the next, on the frame's own grid. Read from the last frame
    to the first (`backwards`), the next frame comes before, and flow is exact; forwards it would
    be on the wrong grid and is not used.

    Args:
        folder: `training`, with `final/`, `depth/`, `camdata_left/` and `flow/`.
        scene: e.g. `alley_1`.
        render: the pass of the pictures, `"final"` or `"clean"`.
        backwards: whether time runs backwards.
    """

    def __init__(
        self, folder: str | Path, *, scene: str, render: str = "final", backwards: bool = False
    ) -> None:
        self.folder, self.scene = Path(folder), scene
        self._pictures = list_files(self.folder / render / scene, (".png",), "frame_")
        if backwards:
            self._pictures.reverse()
        self.count = len(self._pictures)
        flow = self.folder / "flow" / scene
        self.has_flow = bool(backwards) and flow.is_dir()
        self.no_flow = f"no such folder: {flow}" if backwards else PLAY_BACKWARDS

    def _read(self, index: int) -> Frame:
        picture = self._pictures[index]
        K, pose = read_cam(self._file("camdata_left", picture, ".cam"))
        with_flow = self.has_flow and index > 0
        return Frame(
            name=picture.stem,
            source=picture,
            world_from_cam=pose,
            K=K,
            depth=read_dpt(self._file("depth", picture, ".dpt")),
            rgb=read_rgb(picture),
            raw=self._flow(picture) if with_flow else None,
            raw_since=_next_name(picture) if with_flow else None,
        )

    def _file(self, kind: str, picture: Path, suffix: str) -> Path:
        return self.folder / kind / self.scene / f"{picture.stem}{suffix}"

    def _flow(self, picture: Path) -> NDArray[np.float32]:
        """Returns p_t - p_t+1, nan where the data set marks its flow as invalid."""
        flow = -read_flo(self._file("flow", picture, ".flo"))
        invalid = self._file("invalid", picture, ".png")
        if invalid.is_file():
            mask = read_png(invalid, np.uint8) > 0
            if mask.shape != flow.shape[1:]:
                raise SequenceError(invalid, "differs in size from its flow")
            flow[:, mask] = np.nan
        return flow


def _next_name(picture: Path) -> str:
    number = picture.stem.removeprefix("frame_")
    if not number.isdecimal():
        raise SequenceError(picture, "is not named frame_<number>")
    return f"frame_{int(number) + 1:0{len(number)}d}"


def read_dpt(path: Path) -> NDArray[np.float32]:
    """Returns the depth `[H, W]` of a .dpt file, metres."""
    return read_tagged_floats(path, channels=1)[..., 0]


def read_cam(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns K in flowrep's convention and `world_from_cam` of a .cam file."""
    data = read_bytes(path)
    if len(data) != 4 + 8 * (9 + 12) or struct.unpack_from("<f", data)[0] != FLO_TAG:
        raise SequenceError(path, f"is no .cam file: {FLO_TAG}, 9 and 12 doubles")
    K = np.frombuffer(data, "<f8", 9, offset=4).reshape(3, 3).copy()
    K[:2, 2] += 0.5
    extrinsics = np.frombuffer(data, "<f8", 12, offset=4 + 8 * 9)
    return K, as_pose(extrinsics, path, direction="world_to_camera")
