"""A folder exported from a ZED's SVO recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrep.geometry import CameraAxes
from flowrep.geometry.checks import check_name
from flowrep.sequences.calibration import as_pose, check_count, read_cameras, read_pose_lines
from flowrep.sequences.files import DEPTH_FILES, PICTURES, list_files, read_depth, read_rgb
from flowrep.sequences.recording import Frame, Recording, SequenceError


class Zed(Recording):
    """A folder with `left000000.png`, `depth000000.png` (or `.npy`), and two other files.

    `poses.txt` has a line for each picture, `tx ty tz qx qy qz qw`, the left camera's pose in the
    world; without it, the motion has to be estimated. `intrinsics.json` describes the rectified
    left camera, as in `frames`.

    Args:
        folder: the exported folder.
        pose_axes: the coordinate system of the exported poses: `"opencv"` for the SDK's
            IMAGE, `"opengl"` for RIGHT_HANDED_Y_UP, `"x_forward_z_up"` for RIGHT_HANDED_Z_UP_X_FWD.

    Raises:
        ValueError: the axes are unknown.
    """

    def __init__(self, folder: str | Path, *, pose_axes: CameraAxes = "opencv") -> None:
        check_name("pose_axes", pose_axes, CameraAxes)
        self.folder, self.pose_axes = Path(folder), pose_axes
        self._pictures = list_files(self.folder, PICTURES, "left")
        depths = list_files(self.folder, DEPTH_FILES, "depth")
        self._depths = {path.stem.removeprefix("depth"): path for path in depths}
        self.count = len(self._pictures)
        self._poses_path = self.folder / "poses.txt"
        self.has_poses, self.conventions = self._poses_path.is_file(), {"pose_axes": pose_axes}
        if self.has_poses:
            self._poses = read_pose_lines(self._poses_path, "xyz_xyzw")
            check_count(self._poses_path, len(self._poses), len(self), "poses")
        self._camera = read_cameras(self.folder / "intrinsics.json")
        self.K = self._camera.K
        if self._camera.colour is not None:
            raise SequenceError(
                self.folder / "intrinsics.json",
                "names a colour camera; a ZED's depth belongs to the left picture already",
            )

    def _read(self, index: int) -> Frame:
        picture = self._pictures[index]
        number = picture.stem.removeprefix("left")
        if number not in self._depths:
            raise SequenceError(self.folder, f"lacks depth{number} for {picture.name}")
        world_from_cam = None
        if self.has_poses:
            world_from_cam = as_pose(
                self._poses[index], self._poses_path, layout="xyz_xyzw", axes=self.pose_axes
            )
        return Frame(
            name=number,
            source=picture,
            world_from_cam=world_from_cam,
            K=self.K,
            depth=measured(read_depth(self._depths[number], self._camera.size)),
            rgb=read_rgb(picture),
        )


def measured(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns depth with nan where the SDK has none: nan, -inf (too near) and inf (too far).

    Too far does not mean sky: the surface is at an unknown distance beyond the range.
    """
    return np.where(np.isfinite(depth), depth, np.float32(np.nan))
