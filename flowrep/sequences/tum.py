"""TUM RGB-D: pictures, depth maps and poses matched by timestamp."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.calibration import (
    Pose,
    as_pose,
    check_ascending,
    four_intrinsics,
    interpolated_pose,
    nearest,
    opencv_intrinsics,
)
from flowrep.sequences.files import (
    depth_from_integers,
    path_inside,
    read_lines,
    read_png16,
    read_rgb,
    read_table,
)
from flowrep.sequences.recording import Frame, Recording, SequenceError

DEPTH_UNIT_M = 1 / 5000


class Tum(Recording):
    """A folder with `rgb.txt`, `depth.txt` and `groundtruth.txt`.

    The picture sets the time of a frame. It gets the nearest depth map and the nearest pose if they
    are near enough; a picture that lacks either is left out.

    Args:
        folder: the folder of one recording.
        intrinsics: fx, fy, cx, cy in OpenCV's convention.
        tolerance_s: the largest time difference of a depth map or a pose from its picture.
        interpolate: whether the pose is interpolated to the picture's time between the poses before
            and after it, each of which must be within `tolerance_s`.

    Raises:
        SequenceError: a file is missing or invalid; names the file and the cause.
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
        self.K = opencv_intrinsics(four_intrinsics("intrinsics", intrinsics))
        self.tolerance_s, self.interpolate = float(tolerance_s), bool(interpolate)
        rgb_times, rgb_paths = self._index("rgb.txt")
        depth_times, depth_paths = self._index("depth.txt")
        self.trajectory = self.folder / "groundtruth.txt"
        poses = read_table(self.trajectory, [8])
        check_ascending(self.trajectory, poses[:, 0])
        self._pose_times, self._poses = poses[:, 0], poses[:, 1:]
        depth_of = _one_to_one(nearest(depth_times, rgb_times, tolerance_s), depth_times, rgb_times)
        posed = self._has_pose(rgb_times)
        kept = np.flatnonzero((depth_of >= 0) & posed)
        if not len(kept):
            raise SequenceError(
                self.folder,
                f"no picture has a depth map and a pose within {tolerance_s} s: raise tolerance_s, "
                "or check that the three files share a clock",
            )
        self._times = rgb_times[kept]
        self._files = [(rgb_paths[i], depth_paths[depth_of[i]]) for i in kept]
        if left_out := len(rgb_times) - len(kept):
            self.notes = (
                f"{left_out} of {len(rgb_times)} pictures have no depth map or pose within "
                f"{tolerance_s} s and are left out",
            )

    def __len__(self) -> int:
        """Returns the number of pictures with depth and a pose."""
        return len(self._files)

    def _read(self, index: int) -> Frame:
        rgb, depth = self._files[index]
        time_s = float(self._times[index])
        return Frame(
            name=rgb.stem,
            source=rgb,
            world_from_cam=self._pose_at(time_s),
            K=self.K,
            depth=depth_from_integers(read_png16(depth), DEPTH_UNIT_M, missing=(0,)),
            rgb=read_rgb(rgb),
            timestamp_s=time_s,
        )

    def _index(self, name: str) -> tuple[NDArray[np.float64], list[Path]]:
        path = self.folder / name
        times, files = [], []
        for number, line in read_lines(path):
            words = line.split(maxsplit=1)
            try:
                times.append(float(words[0]))
                files.append(path_inside(self.folder, words[1], path))
            except (ValueError, IndexError):
                raise SequenceError(
                    path, f"line {number} is not a timestamp and file name"
                ) from None
        if not times:
            raise SequenceError(path, "names no pictures")
        check_ascending(path, np.array(times))
        return np.array(times), files

    def _has_pose(self, times_s: NDArray[np.float64]) -> NDArray[np.bool_]:
        if not self.interpolate:
            return nearest(self._pose_times, times_s, self.tolerance_s) >= 0
        before, after = self._neighbours(times_s)
        inside = (times_s >= self._pose_times[0]) & (times_s <= self._pose_times[-1])
        gaps = times_s - self._pose_times[before], self._pose_times[after] - times_s
        return inside & (np.maximum(*gaps) <= self.tolerance_s)

    def _neighbours(self, times_s: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        after = np.searchsorted(self._pose_times, times_s).clip(0, len(self._pose_times) - 1)
        exact = self._pose_times[after] == times_s
        return np.where(exact, after, after - 1).clip(0), after

    def _pose_at(self, time_s: float) -> Pose:
        wanted = np.array([time_s])
        if not self.interpolate:
            return self._pose(int(nearest(self._pose_times, wanted, self.tolerance_s)[0]))
        before, after = (int(index[0]) for index in self._neighbours(wanted))
        span = self._pose_times[after] - self._pose_times[before]
        share = float((time_s - self._pose_times[before]) / span) if span > 0 else 0.0
        return interpolated_pose(self._pose(before), self._pose(after), share)

    def _pose(self, index: int) -> Pose:
        return as_pose(self._poses[index], self.trajectory, layout="xyz_xyzw")


def _one_to_one(
    chosen: NDArray[np.int64], times_s: NDArray[np.float64], wanted_s: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Returns `chosen` with each index only where it is nearest in time; -1 for the others."""
    alone = np.full_like(chosen, -1)
    taken: dict[int, int] = {}
    for i, choice in enumerate(chosen.tolist()):
        rival = taken.get(choice)
        gap = abs(times_s[choice] - wanted_s[i])
        if choice < 0 or (rival is not None and abs(times_s[choice] - wanted_s[rival]) <= gap):
            continue
        if rival is not None:
            alone[rival] = -1
        taken[choice], alone[i] = i, choice
    return alone
