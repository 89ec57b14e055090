"""KITTI scene flow 2015: pairs of pictures with disparity, flow, and poses from GPS and IMU."""

from __future__ import annotations

import math
import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.calibration import as_pose, intrinsics, opencv_intrinsics
from flowrep.sequences.files import (
    list_files,
    read_kitti_flow,
    read_lines,
    read_png,
    read_rgb,
    read_table,
)
from flowrep.sequences.recording import Frame, Pose, Recording, SequenceError

EARTH_RADIUS_M = 6378137.0
_OXTS_NUMBERS = 30


class Kitti(Recording):
    """The `training` folder of the benchmark, and the raw recordings that it was taken from.

    Flow and disparity are given on the first picture of each pair (`_10`) and lead to the second
    (`_11`). Time is therefore read backwards: each pair is a clip of two frames, `_11` first, then
    `_10` with depth and flow.

    Args:
        folder: `training`, with `image_2/`, `disp_occ_0/`, `flow_occ/`, `calib_cam_to_cam/` and,
            for poses, `calib_imu_to_velo/` and `calib_velo_to_cam/`.
        raw_data: the raw recordings, `<date>/<drive>/oxts/data/*.txt`; None for no poses.
        mapping: the development kit's `train_mapping.txt`, for poses; line n names the recording
            and frame of pair n. Pairs without one are left out.
    """

    has_flow = True
    one_size = False

    def __init__(
        self,
        folder: str | Path,
        *,
        raw_data: str | Path | None = None,
        mapping: str | Path | None = None,
    ) -> None:
        self.folder, self.has_poses = Path(folder), raw_data is not None
        names = [path.stem for path in list_files(self.folder / "image_2", (".png",))]
        self._pairs = [name[:6] for name in names if re.fullmatch(r"\d{6}_10", name)]
        self.count = 2 * len(self._pairs)
        if raw_data is None:
            return
        if mapping is None:
            raise SequenceError(raw_data, "is of no use without format.mapping=train_mapping.txt")
        self._oxts = {}  # the folder of GPS and IMU packets and the frame number, by pair
        for number, line in read_lines(Path(mapping)):
            words = line.split()
            if len(words) != 3 or not words[2].isdecimal():
                raise SequenceError(mapping, f"line {number} is not a date, recording and frame")
            packets = Path(raw_data) / words[0] / words[1] / "oxts" / "data"
            self._oxts[number - 1] = packets, int(words[2])
        posed = [name for name in self._pairs if int(name) in self._oxts]
        if not posed:
            raise SequenceError(mapping, f"names no raw recording of the pictures in {folder}")
        if left_out := len(self._pairs) - len(posed):
            self.notes = (
                f"{left_out} of {len(self._pairs)} pairs have no raw recording, so no poses",
            )
        self._pairs, self.count = posed, 2 * len(posed)

    def starts_clip(self, index: int) -> bool:
        """Returns whether it is the earlier frame of a pair."""
        return index % 2 == 0

    def _read(self, index: int) -> Frame:
        pair, is_current = self._pairs[index // 2], bool(index % 2)
        name = f"{pair}_{'10' if is_current else '11'}"
        picture = self.folder / "image_2" / f"{name}.png"
        rgb = read_rgb(picture)
        K, focal_baseline, cam_from_cam0 = self._camera(pair)
        depth = np.full(rgb.shape[:2], np.nan, dtype=np.float32)
        if is_current:
            disparity = read_png(self.folder / "disp_occ_0" / f"{name}.png", np.uint16)
            depth = _depth_from_disparity(disparity, focal_baseline)
        world_from_cam = None
        if self.has_poses:
            cam0_from_velo = self._rigid("calib_velo_to_cam", pair)
            cam_from_imu = cam_from_cam0 @ cam0_from_velo @ self._rigid("calib_imu_to_velo", pair)
            packets, first = self._oxts[int(pair)]
            before, path = (packets / f"{first + later:010d}.txt" for later in (0, not is_current))
            latitude_deg = read_table(before, [_OXTS_NUMBERS])[0, 0]
            packet = read_table(path, [_OXTS_NUMBERS])[0]
            world_from_imu = _pose_from_oxts(packet, latitude_deg, path)
            world_from_cam = world_from_imu @ np.linalg.inv(cam_from_imu)
        flow = self.folder / "flow_occ" / f"{name}.png"
        return Frame(
            name=name,
            source=picture,
            world_from_cam=world_from_cam,
            K=K,
            depth=depth,
            rgb=rgb,
            raw=-read_kitti_flow(flow) if is_current else None,
            raw_since=f"{pair}_11" if is_current else None,
            starts_clip=self.starts_clip(index),
        )

    def _camera(self, pair: str) -> tuple[NDArray[np.float64], float, Pose]:
        """Returns K, baseline times fx (px m), and `cam_from_cam0` of the left colour camera."""
        path = self.folder / "calib_cam_to_cam" / f"{pair}.txt"
        entries = _read_calibration(path)
        left, right = (_matrix(path, entries, f"P_rect_{i}", (3, 4)) for i in ("02", "03"))
        fx, fy, cx, cy = left[0, 0], left[1, 1], left[0, 2], left[1, 2]
        if min(fx, fy) <= 0 or not np.array_equal(left[:, :3], intrinsics(fx, fy, cx, cy)):
            raise SequenceError(path, "P_rect_02 should be K [I | t] of a rectified camera")
        focal_baseline = float(left[0, 3] - right[0, 3])
        if not focal_baseline > 0:
            raise SequenceError(path, f"has no baseline between P_rect_02 and 03: {focal_baseline}")
        rotation = _matrix(path, entries, "R_rect_00", (3, 3))
        rectified_from_cam0 = as_pose(np.hstack([rotation, np.zeros((3, 1))]), path)
        # P = K [I | t], so that the left colour camera sees a rectified point at x + K^-1 p.
        cam_from_rectified = np.eye(4)
        cam_from_rectified[:3, 3] = np.linalg.solve(left[:, :3], left[:, 3])
        K = opencv_intrinsics([fx, fy, cx, cy])
        return K, focal_baseline, cam_from_rectified @ rectified_from_cam0

    def _rigid(self, kind: str, pair: str) -> Pose:
        path = self.folder / kind / f"{pair}.txt"
        entries = _read_calibration(path)
        parts = [_matrix(path, entries, "R", (3, 3)), _matrix(path, entries, "T", (3, 1))]
        return as_pose(np.hstack(parts), path)


def _depth_from_disparity(stored: NDArray[np.uint16], focal_baseline: float) -> NDArray[np.float32]:
    """Returns depth in metres, nan where the disparity (in 1/256 px) is 0.

    >>> _depth_from_disparity(np.array([[0, 2560]], np.uint16), 400.0)  # 400 / 10 px
    array([[nan, 40.]], dtype=float32)
    """
    disparity = np.where(stored == 0, np.nan, stored / 256)
    return (focal_baseline / disparity).astype(np.float32)


def _pose_from_oxts(packet: NDArray[np.float64], latitude_deg: float, source: Path) -> Pose:
    """Returns the pose of an IMU with x forward, y left, z up; the world is a Mercator map.

    Args:
        packet: latitude, longitude (degrees), altitude (m), roll, pitch, yaw (rad), and more.
        latitude_deg: the latitude at which the map is true to scale.
        source: the file, for the message.
    """
    latitude, longitude, altitude, *angles = packet[:6]
    if not np.isfinite(packet[:6]).all() or abs(latitude) >= 90 or not abs(latitude_deg) < 90:
        raise SequenceError(source, f"holds no position and attitude: {packet[:6].tolist()}")
    scale = math.cos(math.radians(latitude_deg)) * EARTH_RADIUS_M
    pose = np.eye(4)
    roll, pitch, yaw = (cv2.Rodrigues(a * axis)[0] for a, axis in zip(angles, np.eye(3)))
    pose[:3, :3] = yaw @ pitch @ roll
    pose[:3, 3] = (
        scale * math.radians(longitude),
        scale * math.log(math.tan(math.radians(90 + latitude) / 2)),
        altitude,
    )
    return pose


def _read_calibration(path: Path) -> dict[str, list[float]]:
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
