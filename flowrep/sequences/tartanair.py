"""TartanAir (version 1): simulated flights with depth, poses and the flow of a static world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.calibration import as_pose, check_count, intrinsics, read_pose_lines
from flowrep.sequences.files import list_files, read_npy, read_rgb
from flowrep.sequences.recording import PLAY_BACKWARDS, Frame, Recording, SequenceError


class TartanAir(Recording):
    """A trajectory's folder, e.g. `abandonedfactory/Easy/P000`.

    Its flow leads from each frame to the next and contains only the camera's motion, even where
    objects moved. It is used if frames are read from the last to the first (`backwards`), which
    puts it on the right grid; forwards it is not.

    Args:
        folder: the folder of `image_left/`, `depth_left/`, `pose_left.txt` and, for flow, `flow/`.
        backwards: whether time runs backwards.
    """

    def __init__(self, folder: str | Path, *, backwards: bool = False) -> None:
        self.folder, self.backwards = Path(folder), bool(backwards)
        self._pictures = list_files(self.folder / "image_left", (".png",))
        self.count = len(self._pictures)
        self._poses_path = self.folder / "pose_left.txt"
        self._poses = read_pose_lines(self._poses_path, "xyz_xyzw")
        check_count(self._poses_path, len(self._poses), len(self), "poses")
        flow = self.folder / "flow"
        self.has_flow = self.backwards and flow.is_dir()
        self.no_flow = f"no such folder: {flow}" if backwards else PLAY_BACKWARDS

    def _read(self, index: int) -> Frame:
        place = len(self) - 1 - index if self.backwards else index
        picture = self._pictures[place]
        number, with_flow = self._number(place), self.has_flow and index > 0
        depth = read_npy(self.folder / "depth_left" / f"{number}_left_depth.npy")
        height, width = depth.shape
        return Frame(
            name=number,
            source=picture,
            world_from_cam=as_pose(
                self._poses[place], self._poses_path, layout="xyz_xyzw", axes="ned"
            ),
            # 90 degrees of horizontal view, a centred axis: 320, 320, 320, 240 at 640 x 480.
            K=intrinsics(width / 2, width / 2, width / 2, height / 2),
            depth=depth,
            rgb=read_rgb(picture),
            raw=self._flow(place) if with_flow else None,
            raw_since=self._number(place + 1) if with_flow else None,
        )

    def _number(self, place: int) -> str:
        return self._pictures[place].stem.removesuffix("_left")

    def _flow(self, place: int) -> NDArray[np.float32]:
        """Returns p_t - p_t+1, nan where the point is not visible in the next frame."""
        pair = f"{self._number(place)}_{self._number(place + 1)}"
        path = self.folder / "flow" / f"{pair}_flow.npy"
        flow = -read_npy(path, channels=2).transpose(2, 0, 1)
        mask_path = path.with_name(path.name.replace("_flow", "_mask"))
        if mask_path.is_file():
            mask = read_npy(mask_path, kind="u")
            if mask.shape != flow.shape[1:]:
                raise SequenceError(mask_path, "differs in size from its flow")
            flow[:, mask != 0] = np.nan
        return flow
