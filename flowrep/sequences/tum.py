"""TUM RGB-D: pictures, depth maps and poses matched by timestamp."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.calibration import as_pose, check_numbers, opencv_intrinsics
from flowrep.sequences.files import depth_from_integers, read_lines, read_png, read_rgb, read_table
from flowrep.sequences.recording import Frame, Pose, Recording, SequenceError

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


class Tum(Recording):
    """A folder with `rgb.txt`, `depth.txt` and, for poses, `groundtruth.txt`.

    The picture sets the time of a frame. It gets the nearest depth map and the nearest pose within
    `tolerance_s`; a picture that lacks either is left out.

    Args:
        intrinsics: fx, fy, cx, cy in OpenCV's convention.
        interpolate: whether the pose is interpolated to the picture's time between the poses before
            and after it, each of which must be within `tolerance_s`.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        intrinsics: Sequence[float] = (525.0, 525.0, 319.5, 239.5),
        tolerance_s: float = 0.02,
        interpolate: bool = False,
    ) -> None:
        self.folder = Path(folder)
        check_numbers("intrinsics", intrinsics, "fx, fy, cx, cy")
        self.K = opencv_intrinsics(intrinsics)
        self.tolerance_s, self.interpolate = tolerance_s, interpolate
        rgb_times, rgb_paths = self._index("rgb.txt")
        depth_times, depth_paths = self._index("depth.txt")
        depth_of = nearest(depth_times, rgb_times, tolerance_s)
        # Two pictures may be nearest to one depth map: it belongs to the nearer of them.
        rgb_of = nearest(rgb_times, depth_times, tolerance_s)
        found = (depth_of >= 0) & (rgb_of[depth_of] == np.arange(len(rgb_times)))
        self.trajectory, needed = self.folder / "groundtruth.txt", "depth map"
        self.has_poses = self.trajectory.is_file()
        if self.has_poses:
            needed = "depth map or pose"
            poses = read_table(self.trajectory, 8)
            _check_ascending(self.trajectory, poses[:, 0])
            self._poses = as_pose(poses[:, 1:], self.trajectory, layout="xyz_xyzw")
            self._before, self._after, self._share = self._between(poses[:, 0], rgb_times)
            found &= self._before >= 0
        kept = np.flatnonzero(found)
        if not len(kept):
            cause = f"no picture has a depth map and a pose within {tolerance_s} s: "
            remedy = "raise tolerance_s, or check that the files share a clock"
            raise SequenceError(self.folder, cause + remedy)
        self._kept, self._times, self.count = kept, rgb_times, len(kept)
        self._rgbs, self._depths = rgb_paths, [depth_paths[i] for i in depth_of]
        if left_out := len(rgb_times) - len(kept):
            lack = f"have no {needed} within {tolerance_s} s and are left out"
            self.notes = (f"{left_out} of {len(rgb_times)} pictures {lack}",)

    def _read(self, index: int) -> Frame:
        place = int(self._kept[index])
        rgb, stored = self._rgbs[place], read_png(self._depths[place], np.uint16)
        world_from_cam = None
        if self.has_poses:
            before, after = (self._poses[of[place]] for of in (self._before, self._after))
            world_from_cam = interpolated_pose(before, after, float(self._share[place]))
        depth = depth_from_integers(stored, 1 / 5000, missing=(0,))  # 5000 is a metre
        time_s = float(self._times[place])
        return Frame(rgb.stem, rgb, world_from_cam, self.K, depth, read_rgb(rgb), time_s)

    def _index(self, name: str) -> tuple[Floats, list[Path]]:
        path = self.folder / name
        if not path.is_file():
            raise SequenceError(path, "is missing: give the folder that holds it, or its format=")
        lines = [line.split(maxsplit=1) for line in read_lines(path)]
        try:
            times = np.array([float(time) for time, _ in lines])
        except ValueError:
            raise SequenceError(path, f"is not '<time> {path.stem}/<file>' in each line") from None
        if not lines:
            raise SequenceError(path, "names no pictures")
        _check_ascending(path, times)
        return times, [self.folder / name for _, name in lines]

    def _between(self, pose_times: Floats, times_s: Floats) -> tuple[Indices, Indices, Floats]:
        # Poses before and after each time, -1 if too far, and the share of the way between them.
        if not self.interpolate:
            chosen = nearest(pose_times, times_s, self.tolerance_s)
            return chosen, chosen, np.zeros(len(times_s))
        after = np.searchsorted(pose_times, times_s).clip(0, len(pose_times) - 1)
        before = np.where(pose_times[after] == times_s, after, after - 1)
        gaps = times_s - pose_times[before], pose_times[after] - times_s
        inside = (before >= 0) & (np.minimum(*gaps) >= 0) & (np.maximum(*gaps) <= self.tolerance_s)
        span = np.maximum(pose_times[after] - pose_times[before], 1e-9)
        return np.where(inside, before, -1), after, gaps[0] / span


def _check_ascending(path: Path, times_s: Floats) -> None:
    if not (np.diff(times_s) >= 0).all():  # nan compares False
        raise SequenceError(path, "times go backwards, or are not numbers")


def nearest(times_s: Floats, wanted_s: Floats, tolerance_s: float) -> Indices:
    """Returns the index of the time nearest to each wanted one, -1 if none is near enough."""
    after = np.searchsorted(times_s, wanted_s).clip(0, len(times_s) - 1)
    before = (after - 1).clip(0)
    gap_after, gap_before = (np.abs(times_s[index] - wanted_s) for index in (after, before))
    found = np.where(gap_before <= gap_after, before, after)
    return np.where(np.minimum(gap_before, gap_after) <= tolerance_s, found, -1)


def interpolated_pose(before: Pose, after: Pose, share: float) -> Pose:
    """Returns the pose at a share of the way, with constant velocity and angular velocity."""
    axis_angle, _ = cv2.Rodrigues(before[:3, :3].T @ after[:3, :3])
    pose = np.eye(4)
    pose[:3, :3] = before[:3, :3] @ cv2.Rodrigues(share * axis_angle)[0]
    pose[:3, 3] = (1 - share) * before[:3, 3] + share * after[:3, 3]
    return pose
