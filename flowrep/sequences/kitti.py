"""KITTI scene flow 2015: pairs of pictures with disparity and flow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flowrep.sequences import files
from flowrep.sequences.calibration import camera_matrix
from flowrep.sequences.recording import Frame, Recording, SequenceError


class Kitti(Recording):
    """The `training` folder of the benchmark, which has no poses.

    Flow and disparity are given on the first picture of each pair (`_10`) and lead to the second
    (`_11`). Time is therefore read backwards: each pair is a clip of two frames, `_11` first, then
    `_10` with depth and flow.

    Args:
        folder: `training`, with `image_2/`, `disp_occ_0/`, `flow_occ/` and `calib_cam_to_cam/`.
    """

    has_flow, has_poses = True, False

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._pairs = [*files.find_files(self.folder / "image_2/*_10.png", "picture")]
        if not self._pairs:
            says = "has no image_2/*_10.png: give training/ of the data set"
            raise SequenceError(self.folder, says)
        self.count = 2 * len(self._pairs)

    def _frame(self, index: int) -> Frame:
        pair, is_current = self._pairs[index // 2], bool(index % 2)
        name = f"{pair}_{'10' if is_current else '11'}"
        picture = self.folder / "image_2" / f"{name}.png"
        rgb = files.read_rgb(picture)
        calibration = self.folder / f"calib_cam_to_cam/{pair}.txt"
        numbers = [files.read_table(Path(f"{calibration}:P_rect_0{i}"))[0] for i in (2, 3)]
        try:
            left, right = np.reshape(numbers, (2, 3, 4))
        except ValueError:
            raise SequenceError(calibration, "P_rect_02 or P_rect_03 hasn't 12 numbers") from None
        depth = np.full(rgb.shape[:2], np.nan, dtype=np.float32)
        flow: Any = {}
        if is_current:
            path = self.folder / "disp_occ_0" / f"{name}.png"
            disparity_px = files.read_depth(path, 1 / 256, missing=(0,)).astype(np.float64)
            # P[0, 3] is -fx times the camera's x, so that the difference is fx times the baseline.
            depth = ((left[0, 3] - right[0, 3]) / disparity_px).astype(np.float32)
            # The file has p_11 - p_10. As 11 is the previous frame here, p_t - p_t' is the
            # opposite.
            raw = -files.read_flow(self.folder / "flow_occ" / f"{name}.png")
            flow = {"raw": raw, "raw_since": f"{pair}_11"}
        K = camera_matrix(left, (0, 0), first_pixel_centre=0.0)
        return Frame(name, picture, None, K, depth, rgb, clip=index // 2, **flow)
