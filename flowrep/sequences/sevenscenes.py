"""7-Scenes (Microsoft Research): a Kinect, whose depth is not registered to its colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flowrep.sequences.calibration import Registration, as_pose, check_numbers, intrinsics
from flowrep.sequences.files import depth_from_integers, list_files, read_png, read_rgb, read_table
from flowrep.sequences.recording import Frame, Recording, SequenceError


class SevenScenes(Recording):
    """A folder with `frame-000000.color.png`, `.depth.png` and `.pose.txt`.

    Depth is registered to the colour camera, whose intrinsics the data set does not give; the
    default is those of an uncalibrated Kinect. The poses are the depth camera's; without the files
    `.pose.txt`, the camera's motion has to be estimated.

    Args:
        folder: the folder of one sequence, e.g. `chess/seq-01`.
        depth_intrinsics: fx, fy, cx, cy, pixel (0, 0)'s centre at (0.5, 0.5).
        colour_intrinsics: those of the colour camera.
        colour_from_depth_m: a point's position in the colour camera's frame minus that in the depth
            camera's: x, y, z. The data set does not give it either.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        depth_intrinsics: Sequence[float] = (585.0, 585.0, 320.0, 240.0),
        colour_intrinsics: Sequence[float] = (525.0, 525.0, 320.0, 240.0),
        colour_from_depth_m: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.folder = Path(folder)
        check_numbers("depth_intrinsics", depth_intrinsics, "fx, fy, cx, cy")
        check_numbers("colour_intrinsics", colour_intrinsics, "fx, fy, cx, cy")
        check_numbers("colour_from_depth_m", colour_from_depth_m, "x, y, z")
        self._K_depth, self.K = intrinsics(*depth_intrinsics), intrinsics(*colour_intrinsics)
        self._colour_from_depth = np.eye(4)
        self._colour_from_depth[:3, 3] = colour_from_depth_m
        pictures = list_files(self.folder, (".png", ".jpg"), "frame-")
        self._colours = [path for path in pictures if path.stem.endswith(".color")]
        self.count = len(self._colours)
        if not self.count:
            raise SequenceError(self.folder, "holds no frame-*.color.png or .color.jpg")
        first = self._colours[0].name.split(".")[0]
        self.has_poses = (self.folder / f"{first}.pose.txt").is_file()
        self._registration: Registration | None = None

    def _read(self, index: int) -> Frame:
        colour = self._colours[index]
        name = colour.name.split(".")[0]
        rgb = read_rgb(colour)
        stored = read_png(self.folder / f"{name}.depth.png", np.uint16)
        if self._registration is None:
            size = rgb.shape[0], rgb.shape[1]
            self._registration = Registration(self._K_depth, self.K, self._colour_from_depth, size)
        register = self._registration
        world_from_cam = None
        if self.has_poses:
            path = self.folder / f"{name}.pose.txt"
            pose = as_pose(read_table(path, 4).ravel(), path)
            world_from_cam = pose @ register.depth_from_colour
        depth = register(depth_from_integers(stored, 0.001, missing=(0, 65535)))
        return Frame(name, colour, world_from_cam, self.K, depth, rgb)
