"""KITTI scene flow 2015: pairs of pictures with disparity, flow, and poses from GPS and IMU."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences import files
from flowrep.sequences.calibration import as_pose, camera_matrix
from flowrep.sequences.recording import Frame, Pose, Recording, SequenceError

EARTH_RADIUS_M = 6378137.0


class Kitti(Recording):
    """The `training` folder of the benchmark, and the raw recordings from which it was taken.

    Flow and disparity are given on the first picture of each pair (`_10`) and lead to the second
    (`_11`). Time is therefore read backwards: each pair is a clip of two frames, `_11` first, then
    `_10` with depth and flow.

    Args:
        folder: `training`, with `image_2/`, `disp_occ_0/`, `flow_occ/`, `calib_cam_to_cam/` and,
            for poses, `calib_imu_to_velo/` and `calib_velo_to_cam/`.
        raw_data: the raw recordings, `<date>/<drive>/oxts/data/*.txt`; None for no poses.
        mapping: the development kit's `train_mapping.txt`, for poses; line n names the recording
            and frame of pair n.
    """

    has_flow = True

    def __init__(
        self,
        folder: str | Path,
        *,
        raw_data: str | Path | None = None,
        mapping: str | Path | None = None,
    ) -> None:
        self.folder, self.has_poses = Path(folder), raw_data is not None
        names = files.find_files(self.folder / "image_2/*.png", "picture")
        self._pairs = [name[:6] for name in names if re.fullmatch(r"\d{6}_10", name)]
        if not self._pairs:
            raise SequenceError(
                self.folder, "has no image_2/*_10.png: give training/ of the data set"
            )
        self.count = 2 * len(self._pairs)
        if raw_data is None and mapping is None:
            return
        if raw_data is None:
            raise SequenceError(mapping, "needs format.raw_data=<raw recordings>, too")
        if mapping is None:
            raise SequenceError(raw_data, "needs format.mapping=train_mapping.txt, too")
        self._oxts = {}  # the folder of GPS and IMU packets and the frame number, by pair
        for pair, line in enumerate(
            files.regular(Path(mapping)).read_text("utf-8-sig").splitlines()
        ):
            words = line.split()  # none if the pair has no raw recording
            if words and (len(words) != 3 or not words[2].isdecimal()):
                raise SequenceError(mapping, f"{line[:60]!r} is not a date, recording and frame")
            if words:
                self._oxts[pair] = Path(raw_data, *words[:2], "oxts", "data"), int(words[2])
        posed = [name for name in self._pairs if int(name) in self._oxts]
        if not posed:
            raise SequenceError(mapping, f"names no raw recording of the pictures in {folder}")
        if left_out := len(self._pairs) - len(posed):
            note = f"{left_out} of {len(self._pairs)} pairs have no raw recording, so no poses"
            self.notes = (note,)
        self._pairs, self.count = posed, 2 * len(posed)

    def _read(self, index: int) -> Frame:
        pair, is_current = self._pairs[index // 2], bool(index % 2)
        name = f"{pair}_{'10' if is_current else '11'}"
        picture = self.folder / "image_2" / f"{name}.png"
        rgb = files.read_rgb(picture)
        K, focal_baseline, cam_from_cam0 = self._camera(pair)
        depth = np.full(rgb.shape[:2], np.nan, dtype=np.float32)
        raw = since = None
        if is_current:
            path = self.folder / "disp_occ_0" / f"{name}.png"
            disparity_px = files.read_depth(path, 1 / 256, missing=(0,)).astype(np.float64)
            depth = (focal_baseline / disparity_px).astype(np.float32)
            # The file has p_11 - p_10. As 11 is the previous frame here, p_t - p_t' is the
            # opposite.
            raw = -files.read_flow(self.folder / "flow_occ" / f"{name}.png")
            since = f"{pair}_11"
        world_from_cam = None
        if self.has_poses:
            cam0_from_velo = self._rigid("calib_velo_to_cam", pair)
            cam_from_imu = cam_from_cam0 @ cam0_from_velo @ self._rigid("calib_imu_to_velo", pair)
            packets, first = self._oxts[int(pair)]
            # The map is true to scale at the latitude of the pair's first frame in time.
            before, path = (packets / f"{first + later:010d}.txt" for later in (0, not is_current))
            latitude_deg = files.read_table(before)[0, 0]
            packet = files.read_table(path)[0]
            world_from_imu = _pose_from_oxts(packet, latitude_deg)
            world_from_cam = world_from_imu @ np.linalg.inv(cam_from_imu)
        flow: Any = {"raw": raw, "raw_since": since}
        return Frame(name, picture, world_from_cam, K, depth, rgb, clip=index // 2, **flow)

    def _camera(self, pair: str) -> tuple[NDArray[np.float64], float, Pose]:
        """Returns K, baseline times fx (px m), and `cam_from_cam0` of the left colour camera."""
        path = self.folder / "calib_cam_to_cam" / f"{pair}.txt"
        left, right, rotation = _matrices(
            path, P_rect_02=(3, 4), P_rect_03=(3, 4), R_rect_00=(3, 3)
        )
        rectified_from_cam0 = as_pose(np.hstack([rotation, np.zeros((3, 1))]).ravel(), path)
        # P = K [I | t], so that the left colour camera sees a rectified point at x + K^-1 p.
        cam_from_rectified = np.eye(4)
        cam_from_rectified[:3, 3] = np.linalg.solve(left[:, :3], left[:, 3])
        K = camera_matrix(left, (0, 0), first_pixel_centre=0.0)
        return K, float(left[0, 3] - right[0, 3]), cam_from_rectified @ rectified_from_cam0

    def _rigid(self, kind: str, pair: str) -> Pose:
        path = self.folder / kind / f"{pair}.txt"
        return as_pose(np.hstack(_matrices(path, R=(3, 3), T=(3, 1))).ravel(), path)


def _pose_from_oxts(packet: NDArray[np.float64], latitude_deg: float) -> Pose:
    # The pose of an IMU with x forward, y left, z up. The world is a Mercator map that is true to
    # scale at the given latitude. Of the packet: degrees twice, metres, radians.
    latitude, longitude, altitude, *angles = packet[:6]
    scale = math.cos(math.radians(latitude_deg)) * EARTH_RADIUS_M
    pose = np.eye(4)
    roll, pitch, yaw = (cv2.Rodrigues(a * axis)[0] for a, axis in zip(angles, np.eye(3)))
    pose[:3, :3] = yaw @ pitch @ roll
    north = scale * math.log(math.tan(math.radians(90 + latitude) / 2))
    pose[:3, 3] = scale * math.radians(longitude), north, altitude
    return pose


def _matrices(path: Path, **shapes: tuple[int, int]) -> list[NDArray[np.float64]]:
    texts = dict(line.partition(":")[::2] for line in files.read_lines(path))
    try:
        return [np.array(texts[n].split(), np.float64).reshape(s) for n, s in shapes.items()]
    except (KeyError, ValueError) as error:
        raise SequenceError(path, f"lacks one of {', '.join(shapes)}: {error}") from None
