"""KITTI scene flow 2015: pairs of pictures with disparity, flow, and poses from GPS and IMU."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.calibration import Pose, as_pose, intrinsics, opencv_intrinsics
from flowrep.sequences.files import (
    list_files,
    read_kitti_flow,
    read_lines,
    read_png,
    read_rgb,
    read_table,
)
from flowrep.sequences.recording import Frame, Recording, SequenceError

EARTH_RADIUS_M = 6378137.0
_OXTS_NUMBERS = 30


@dataclass(frozen=True)
class _Calibration:
    """K, the baseline times fx (px m), and `imu_from_cam` of the left colour camera."""

    K: NDArray[np.float64]
    focal_baseline: float
    imu_from_cam: NDArray[np.float64]


class Kitti(Recording):
    """The `training` folder of the benchmark, with the raw recordings that it was taken from.

    Flow and disparity are given on the first picture of each pair (`_10`) and lead to the second
    (`_11`). Time is therefore read backwards: each pair is a clip of two frames, `_11` first, then
    `_10` with depth and flow. Pairs without a raw recording have no poses and are left out.

    Args:
        folder: `training`, with `image_2/`, `disp_occ_0/`, `flow_occ/`, `calib_cam_to_cam/`,
            `calib_imu_to_velo/` and `calib_velo_to_cam/`.
        raw_data: the raw recordings, `<date>/<drive>/oxts/data/*.txt`.
        mapping: the development kit's `train_mapping.txt`; line n names the recording and frame of
            pair n.

    Raises:
        SequenceError: a file is missing or invalid; names the file and the cause.
    """

    has_flow = True
    one_size = False

    def __init__(self, folder: str | Path, *, raw_data: str | Path, mapping: str | Path) -> None:
        self.folder, self.raw_data = Path(folder), Path(raw_data)
        self._oxts = self._recordings(Path(mapping))
        pairs = [path.stem for path in list_files(self.folder / "image_2", (".png",))]
        firsts = [name.removesuffix("_10") for name in pairs if re.fullmatch(r"\d{6}_10", name)]
        self._pairs = [name for name in firsts if int(name) in self._oxts]
        if not self._pairs:
            raise SequenceError(mapping, f"names no raw recording of the pictures in {folder}")
        if left_out := len(firsts) - len(self._pairs):
            self.notes = (f"{left_out} of {len(firsts)} pairs have no raw recording, so no poses",)

    def __len__(self) -> int:
        """Returns the number of frames: two per pair."""
        return 2 * len(self._pairs)

    def starts_clip(self, index: int) -> bool:
        """Returns whether it is the earlier frame of a pair."""
        return index % 2 == 0

    def _read(self, index: int) -> Frame:
        pair, is_current = self._pairs[index // 2], bool(index % 2)
        name = f"{pair}_{'10' if is_current else '11'}"
        picture = self.folder / "image_2" / f"{name}.png"
        rgb, calibration = read_rgb(picture), self._calibration(pair)
        depth = np.full(rgb.shape[:2], np.nan, dtype=np.float32)
        if is_current:
            disparity = read_png(self.folder / "disp_occ_0" / f"{name}.png", np.uint16)
            depth = depth_from_disparity(disparity, calibration.focal_baseline)
        flow = self.folder / "flow_occ" / f"{name}.png"
        world_from_imu = self._world_from_imu(int(pair), 0 if is_current else 1)
        return Frame(
            name=name,
            source=picture,
            world_from_cam=world_from_imu @ calibration.imu_from_cam,
            K=calibration.K,
            depth=depth,
            rgb=rgb,
            raw=-read_kitti_flow(flow) if is_current else None,
            raw_since=f"{pair}_11" if is_current else None,
            starts_clip=self.starts_clip(index),
        )

    def _recordings(self, mapping: Path) -> dict[int, tuple[Path, int]]:
        """Returns the folder of GPS and IMU packets and the frame number by pair."""
        found = {}
        text = {number: line.split() for number, line in read_lines(mapping)}
        for number, words in text.items():
            if len(words) != 3 or not words[2].isdecimal():
                raise SequenceError(mapping, f"line {number} is not a date, recording and frame")
            drive = self.raw_data / words[0] / words[1]
            found[number - 1] = drive / "oxts" / "data", int(words[2])
        return found

    def _world_from_imu(self, pair: int, frames_later: int) -> Pose:
        """Returns the pose of the IMU, in a world whose axes are east, north and up."""
        folder, first = self._oxts[pair]
        path = folder / f"{first + frames_later:010d}.txt"
        before = read_table(folder / f"{first:010d}.txt", [_OXTS_NUMBERS])[0]
        return pose_from_oxts(read_table(path, [_OXTS_NUMBERS])[0], before[0], path)

    def _calibration(self, pair: str) -> _Calibration:
        path = self.folder / "calib_cam_to_cam" / f"{pair}.txt"
        cameras = read_calibration(path)
        left, right = (_matrix(path, cameras, f"P_rect_{i}", (3, 4)) for i in ("02", "03"))
        rotation = _matrix(path, cameras, "R_rect_00", (3, 3))
        rectified_from_cam0 = as_pose(np.hstack([rotation, np.zeros((3, 1))]), path)
        fx, fy, cx, cy = left[0, 0], left[1, 1], left[0, 2], left[1, 2]
        if min(fx, fy) <= 0 or not np.array_equal(left[:, :3], intrinsics(fx, fy, cx, cy)):
            raise SequenceError(path, "P_rect_02 should be K [I | t] of a rectified camera")
        # P = K [I | t], so that the left colour camera sees a rectified point at x + K^-1 p.
        cam_from_rectified = np.eye(4)
        cam_from_rectified[:3, 3] = np.linalg.solve(left[:, :3], left[:, 3])
        cam0_from_velo = self._rigid("calib_velo_to_cam", pair)
        velo_from_imu = self._rigid("calib_imu_to_velo", pair)
        cam_from_imu = cam_from_rectified @ rectified_from_cam0 @ cam0_from_velo @ velo_from_imu
        focal_baseline = float(left[0, 3] - right[0, 3])
        if not focal_baseline > 0:
            raise SequenceError(path, f"has no baseline between P_rect_02 and 03: {focal_baseline}")
        K = opencv_intrinsics([fx, fy, cx, cy])
        return _Calibration(K, focal_baseline, np.linalg.inv(cam_from_imu).astype(np.float64))

    def _rigid(self, kind: str, pair: str) -> NDArray[np.float64]:
        path = self.folder / kind / f"{pair}.txt"
        entries = read_calibration(path)
        rotation = _matrix(path, entries, "R", (3, 3))
        translation = _matrix(path, entries, "T", (3, 1))
        return as_pose(np.hstack([rotation, translation]), path)


def depth_from_disparity(stored: NDArray[np.uint16], focal_baseline: float) -> NDArray[np.float32]:
    """Returns depth in metres, nan where the disparity (in 1/256 px) is 0.

    >>> depth_from_disparity(np.array([[0, 2560]], np.uint16), 400.0)  # 400 / 10 px
    array([[nan, 40.]], dtype=float32)
    """
    disparity = np.where(stored == 0, np.nan, stored / 256)
    return (focal_baseline / disparity).astype(np.float32)


def pose_from_oxts(packet: NDArray[np.float64], latitude_deg: float, source: Path) -> Pose:
    """Returns the pose of an IMU with x forward, y left, z up; the world is a Mercator map.

    Args:
        packet: latitude, longitude (degrees), altitude (m), roll, pitch, yaw (rad), and more.
        latitude_deg: the latitude at which the map is true to scale.
        source: the file, for the message.

    Raises:
        SequenceError: a number is not finite, or a latitude is out of range.
    """
    if not np.isfinite(packet[:6]).all() or abs(packet[0]) >= 90 or not abs(latitude_deg) < 90:
        raise SequenceError(source, f"holds no position and attitude: {packet[:6].tolist()}")
    latitude, longitude, altitude, roll, pitch, yaw = packet[:6]
    scale = math.cos(math.radians(latitude_deg)) * EARTH_RADIUS_M
    pose = np.eye(4)
    about_x, about_y, about_z = (
        cv2.Rodrigues(angle * axis)[0] for angle, axis in zip((roll, pitch, yaw), np.eye(3))
    )
    pose[:3, :3] = about_z @ about_y @ about_x
    pose[:3, 3] = (
        scale * math.radians(longitude),
        scale * math.log(math.tan(math.radians(90 + latitude) / 2)),
        altitude,
    )
    return pose


def read_calibration(path: Path) -> dict[str, list[float]]:
    """Returns the numbers of a KITTI calibration file by name."""
    entries: dict[str, list[float]] = {}
    for _, line in read_lines(path):
        name, _, values = line.partition(":")
        try:
            entries[name] = [float(value) for value in values.split()]
        except ValueError:  # a date
            continue
    return entries


def _matrix(
    path: Path, entries: dict[str, list[float]], name: str, shape: tuple[int, int]
) -> NDArray[np.float64]:
    values = np.array(entries.get(name, []))
    if values.size != math.prod(shape) or not np.isfinite(values).all():
        raise SequenceError(path, f"{name} should be {math.prod(shape)} numbers")
    return values.reshape(shape)
