"""Rendered data sets, exact in depth, poses and flow: MPI Sintel, TartanAir, Virtual KITTI 2."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrep.sequences import files
from flowrep.sequences.calibration import as_pose, intrinsics, opencv_intrinsics, read_poses
from flowrep.sequences.recording import Frame, Pose, Recording, SequenceError

PLAY_BACKWARDS = (
    "its flow leads to the next frame: format.backwards=true plays it from the last frame to the "
    "first, where that is the previous one"
)


class Sintel(Recording):
    """One scene of MPI Sintel's `training` folder, with depth and camera data unpacked into it.

    Its flow leads from each frame to the next, on the frame's own grid. Read from the last frame
    to the first (`backwards`), the next frame comes before, and flow is exact; forwards it would
    be on the wrong grid and is not used.

    Args:
        folder: `training`, with `final/`, `depth/`, `camdata_left/` and `flow/`.
        scene: e.g. `alley_1`.
        render: the pass of the pictures, `"final"` or `"clean"`.
    """

    def __init__(
        self, folder: str | Path, *, scene: str, render: str = "final", backwards: bool = False
    ) -> None:
        self.folder, self.scene = Path(folder), scene
        pictures = files.list_files(self.folder / render / scene, (".png",), "frame_")
        self._pictures = pictures[::-1] if backwards else pictures
        self.count = len(pictures)
        flow = self.folder / "flow" / scene
        self.has_flow = backwards and flow.is_dir()
        self.no_flow = f"no such folder: {flow}" if backwards else PLAY_BACKWARDS

    def _read(self, index: int) -> Frame:
        picture = self._pictures[index]
        K, world_from_cam = _read_cam(self._file("camdata_left", picture, ".cam"))
        depth = files.read_tagged_floats(self._file("depth", picture, ".dpt"), 1)[..., 0]
        raw = since = None
        if self.has_flow and index > 0:
            number = picture.stem.removeprefix("frame_")
            since = f"frame_{int(number) + 1:0{len(number)}d}"
            # Given is the next frame's position minus this one's, and the next was the one before.
            raw = -files.read_flo(self._file("flow", picture, ".flo"))
            invalid = self._file("invalid", picture, ".png")
            if invalid.is_file():
                raw[:, files.read_png(invalid, np.uint8) != 0] = np.nan
        rgb = files.read_rgb(picture)
        return Frame(picture.stem, picture, world_from_cam, K, depth, rgb, raw=raw, raw_since=since)

    def _file(self, kind: str, picture: Path, suffix: str) -> Path:
        return self.folder / kind / self.scene / f"{picture.stem}{suffix}"


def _read_cam(path: Path) -> tuple[NDArray[np.float64], Pose]:
    data = path.read_bytes()
    if len(data) != 4 + 8 * (9 + 12) or struct.unpack_from("<f", data)[0] != files.FLO_TAG:
        raise SequenceError(path, f"is no .cam file: {files.FLO_TAG}, 9 and 12 doubles")
    K = np.frombuffer(data, "<f8", 9, offset=4).reshape(3, 3).copy()
    K[:2, 2] += 0.5
    extrinsics = np.frombuffer(data, "<f8", 12, offset=4 + 8 * 9)
    return K, as_pose(extrinsics, path, direction="world_to_camera")


class TartanAir(Recording):
    """A trajectory's folder of TartanAir (version 1), e.g. `abandonedfactory/Easy/P000`.

    It holds `image_left/`, `depth_left/`, `pose_left.txt` and, for flow, `flow/`. Flow leads from
    each frame to the next and contains only the camera's motion, even where objects moved. As in
    `Sintel`, it is used `backwards` alone.
    """

    def __init__(self, folder: str | Path, *, backwards: bool = False) -> None:
        self.folder, order = Path(folder), slice(None, None, -1 if backwards else 1)
        self._pictures = files.list_files(self.folder / "image_left", (".png",))[order]
        self.count = len(self._pictures)
        self._poses = read_poses(self.folder / "pose_left.txt", len(self), axes="ned")[order]
        flow = self.folder / "flow"
        self.has_flow = backwards and flow.is_dir()
        self.no_flow = f"no such folder: {flow}" if backwards else PLAY_BACKWARDS

    def _read(self, index: int) -> Frame:
        number, raw, since = self._number(index), None, None
        depth = files.read_npy(self.folder / "depth_left" / f"{number}_left_depth.npy")
        height, width = depth.shape
        if self.has_flow and index > 0:
            since = self._number(index - 1)  # named in the file, so a gap is a missing file
            flow = self.folder / "flow" / f"{number}_{since}_flow.npy"
            raw = -files.read_npy(flow, dims=3).transpose(2, 0, 1)
            hidden = flow.with_name(f"{number}_{since}_mask.npy")
            if hidden.is_file():
                raw[:, files.read_npy(hidden) != 0] = np.nan
        # 90 degrees of horizontal view, a centred axis: 320, 320, 320, 240 at 640 x 480.
        K = intrinsics(width / 2, width / 2, width / 2, height / 2)
        picture, pose = self._pictures[index], self._poses[index]
        rgb = files.read_rgb(picture)
        return Frame(number, picture, pose, K, depth, rgb, raw=raw, raw_since=since)

    def _number(self, index: int) -> str:
        return self._pictures[index].stem.removesuffix("_left")


class VKitti2(Recording):
    """The folder of one variation of one scene of Virtual KITTI 2, e.g. `Scene01/clone`.

    It holds `extrinsic.txt`, `intrinsic.txt` and `frames/`. `camera` is 0 for the left one, 1 for
    the right one.
    """

    def __init__(self, folder: str | Path, *, camera: int = 0) -> None:
        self.folder, self.camera = Path(folder), camera
        self._poses = self._of_camera(self.folder / "extrinsic.txt", 18)
        self._intrinsics = self._of_camera(self.folder / "intrinsic.txt", 6)
        self._pictures = files.list_files(self._maps("rgb"), (".jpg", ".png"))
        self.count = len(self._pictures)
        self.has_flow = self._maps("backwardFlow").is_dir()
        self.no_flow = f"no such folder: {self._maps('backwardFlow')}"

    def _read(self, index: int) -> Frame:
        picture = self._pictures[index]
        name = picture.stem.removeprefix("rgb_")
        number, path = int(name), self.folder / "extrinsic.txt"
        if number not in self._poses or number not in self._intrinsics:
            raise SequenceError(path, f"has no pose or intrinsics of frame {number}")
        pose = as_pose(self._poses[number], path, direction="world_to_camera")
        K = opencv_intrinsics(self._intrinsics[number].tolist())
        centimetres = files.read_png(self._maps("depth") / f"depth_{name}.png", np.uint16)
        depth = files.depth_from_integers(centimetres, 0.01, no_surface=65535)
        raw = since = None
        if self.has_flow and index > 0:
            # Stored is the flow to the previous frame, on this one's grid.
            raw = -_read_vkitti_flow(self._maps("backwardFlow") / f"backwardFlow_{name}.png")
            since = f"{number - 1:0{len(name)}d}"
        rgb = files.read_rgb(picture)
        return Frame(name, picture, pose, K, depth, rgb, raw=raw, raw_since=since)

    def _maps(self, kind: str) -> Path:
        return self.folder / "frames" / kind / f"Camera_{self.camera}"

    def _of_camera(self, path: Path, columns: int) -> dict[int, NDArray[np.float64]]:
        table = files.read_table(path, columns, header=True)
        rows = table[table[:, 1] == self.camera]
        if not len(rows):
            raise SequenceError(path, f"says nothing of camera {self.camera}")
        return {int(row[0]): row[2:] for row in rows}


def _read_vkitti_flow(path: Path) -> files.Flow:
    """Returns flow `[2, H, W]`, 2 I / 65535 - 1 of the picture's size; nan where blue is 0."""
    red, green, blue = files.read_png(path, np.uint16, 3).transpose(2, 0, 1)
    height, width = red.shape
    share = np.stack([red, green]).astype(np.float32) * np.float32(2 / 65535) - 1
    flow = share * np.array([width - 1, height - 1], np.float32)[:, None, None]
    flow[:, blue == 0] = np.nan
    return flow
