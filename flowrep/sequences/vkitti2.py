"""Virtual KITTI 2: rendered streets with exact depth, poses and flow."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.calibration import as_pose, opencv_intrinsics
from flowrep.sequences.files import (
    Flow,
    depth_from_integers,
    list_files,
    read_png,
    read_rgb,
    read_table,
)
from flowrep.sequences.recording import Frame, Recording, SequenceError

DEPTH_UNIT_M = 0.01


class VKitti2(Recording):
    """The folder of one variation of one scene, e.g. `Scene01/clone`.

    Its `backwardFlow` leads from each frame to the previous one, on the frame's own grid; raw flow
    is its negative.

    Args:
        folder: the folder of `extrinsic.txt`, `intrinsic.txt` and `frames/`.
        camera: 0 for the left camera, 1 for the right one.
    """

    def __init__(self, folder: str | Path, *, camera: int = 0) -> None:
        self.folder, self.camera = Path(folder), int(camera)
        self._poses_path = self.folder / "extrinsic.txt"
        self._poses = self._of_camera(self._poses_path, 18)
        self._intrinsics = self._of_camera(self.folder / "intrinsic.txt", 6)
        self._pictures = list_files(self._maps("rgb"), (".jpg", ".png"))
        self.count = len(self._pictures)
        self.has_flow = self._maps("backwardFlow").is_dir()
        self.no_flow = f"no such folder: {self._maps('backwardFlow')}"

    def _read(self, index: int) -> Frame:
        picture = self._pictures[index]
        found = re.fullmatch(r"rgb_(\d+)", picture.stem)
        if not found:
            raise SequenceError(picture, "is not named rgb_<number>")
        number = int(found[1])
        if number not in self._poses or number not in self._intrinsics:
            raise SequenceError(self._poses_path, f"has no pose or intrinsics of frame {number}")
        depth = read_png(self._maps("depth") / f"depth_{found[1]}.png", np.uint16)
        flow = self._maps("backwardFlow") / f"backwardFlow_{found[1]}.png"
        has_flow = self.has_flow and index > 0
        return Frame(
            name=found[1],
            source=picture,
            world_from_cam=as_pose(
                self._poses[number], self._poses_path, direction="world_to_camera"
            ),
            K=opencv_intrinsics(self._intrinsics[number].tolist()),
            depth=depth_from_integers(depth, DEPTH_UNIT_M, no_surface=65535),
            rgb=read_rgb(picture),
            raw=-read_vkitti_flow(flow) if has_flow else None,
            raw_since=f"{number - 1:0{len(found[1])}d}" if has_flow else None,
        )

    def _maps(self, kind: str) -> Path:
        return self.folder / "frames" / kind / f"Camera_{self.camera}"

    def _of_camera(self, path: Path, columns: int) -> dict[int, NDArray[np.float64]]:
        table = read_table(path, [columns], header=True)
        rows = table[table[:, 1] == self.camera]
        if not len(rows):
            raise SequenceError(path, f"says nothing of camera {self.camera}")
        return {int(row[0]): row[2:] for row in rows}


def read_vkitti_flow(path: Path) -> Flow:
    """Returns the flow `[2, H, W]` of a Virtual KITTI 2 PNG, nan where its blue channel is 0."""
    red, green, blue = read_png(path, np.uint16, 3).transpose(2, 0, 1)
    height, width = red.shape
    share = np.stack([red, green]).astype(np.float32) * np.float32(2 / 65535) - 1
    flow = share * np.array([width - 1, height - 1], np.float32)[:, None, None]
    flow[:, blue == 0] = np.nan
    return flow
