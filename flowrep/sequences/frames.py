"""The plain layout, which any recording can be written in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from flowrep.geometry import (
    CameraAxes,
    Channels,
    DepthKind,
    Direction,
    Grid,
    PoseDirection,
    PoseLayout,
    adapt_depth,
    adapt_flow,
)
from flowrep.geometry.checks import check_name
from flowrep.geometry.depth import check_depth_options
from flowrep.geometry.flow import check_flow_options
from flowrep.sequences.calibration import (
    Registration,
    as_pose,
    check_ascending,
    read_cameras,
    read_pose_lines,
)
from flowrep.sequences.files import (
    DEPTH_FILES,
    PICTURES,
    list_files,
    read_depth,
    read_flo,
    read_kitti_flow,
    read_rgb,
    read_table,
)
from flowrep.sequences.recording import Frame, Recording, SequenceError

FLOW_FILES = (".flo", ".png")


class Frames(Recording):
    """A folder with `depth/`, `poses.txt`, `intrinsics.json` and `rgb/`, `flow/` or both.

    Files of one frame share their name up to the suffix; `poses.txt` has a line for each, in the
    order of their numbers. `timestamps.txt` is optional. docs/factorize.md shows every file.

    Args:
        folder: the recording's folder.
        pose_layout: layout of a line, see `flowrep.geometry.adapt_pose`; a matrix has 12 or 16
            numbers.
        pose_direction: see there.
        pose_axes: see there.
        depth_unit_m: the length of 1 in a .png, metres.
        depth_kind: see `flowrep.geometry.adapt_depth`.
        near_m: only for `"z_buffer"`.
        far_m: only for `"z_buffer"`.
        flow_direction: direction of `flow/`, see `flowrep.geometry.adapt_flow`.
        flow_grid: see there.
        flow_channels: see there.

    Raises:
        SequenceError: a file is missing or invalid; names the file and the cause.
        ValueError: a name is unknown, or an option doesn't apply to the kind of depth.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        pose_layout: PoseLayout = "matrix",
        pose_direction: PoseDirection = "camera_to_world",
        pose_axes: CameraAxes = "opencv",
        depth_unit_m: float = 0.001,
        depth_kind: DepthKind = "z",
        near_m: float | None = None,
        far_m: float | None = None,
        flow_direction: Direction = "forward",
        flow_grid: Grid = "current",
        flow_channels: Channels = "uv",
    ) -> None:
        self.folder = Path(folder)
        check_name("pose_layout", pose_layout, PoseLayout)
        check_name("pose_direction", pose_direction, PoseDirection)
        check_name("pose_axes", pose_axes, CameraAxes)
        check_depth_options(depth_kind, depth_kind == "ray_length", near_m, far_m)
        check_flow_options(flow_direction, flow_grid, flow_channels)
        if not depth_unit_m > 0:
            raise ValueError(f"depth_unit_m is positive, got {depth_unit_m}")
        self.pose_layout, self.pose_direction, self.pose_axes = (
            pose_layout, pose_direction, pose_axes,
        )  # fmt: skip
        self.depth_unit_m, self.depth_kind = float(depth_unit_m), depth_kind
        self.near_m, self.far_m = near_m, far_m
        self.flow_direction, self.flow_grid, self.flow_channels = (
            flow_direction, flow_grid, flow_channels,
        )  # fmt: skip
        self._open()

    def _open(self) -> None:
        self._depths = list_files(self.folder / "depth", DEPTH_FILES)
        self._rgbs = self._by_stem("rgb", PICTURES)
        self._flows = self._by_stem("flow", FLOW_FILES)
        if not self._rgbs and not self._flows:
            raise SequenceError(self.folder, "has neither rgb/ nor flow/: one of them is needed")
        self.has_flow = bool(self._flows)
        self._poses_path = self.folder / "poses.txt"
        if not self._poses_path.is_file():
            raise SequenceError(
                self._poses_path,
                "no such file: flow can't be factorised without the camera's poses; "
                "a camera that stands still needs none, see format=video",
            )
        self._poses = read_pose_lines(self._poses_path, self.pose_layout, len(self))
        self._times = self._timestamps()
        self._camera, colour, colour_from_depth = read_cameras(self.folder / "intrinsics.json")
        self._registration, self.K = None, self._camera.K
        if colour is not None and colour_from_depth is not None:
            path = self.folder / "intrinsics.json"
            colour_from_depth = as_pose(colour_from_depth, path)
            self._registration = Registration(
                self._camera.K, colour.K, colour_from_depth, colour.size
            )
            self.K = colour.K

    def __len__(self) -> int:
        """Returns the number of depth maps."""
        return len(self._depths)

    def _read(self, index: int) -> Frame:
        depth_path = self._depths[index]
        name = depth_path.stem
        for kind, files in {"rgb": self._rgbs, "flow": self._flows}.items():
            if files and name not in files and not (kind == "flow" and index == 0):
                raise SequenceError(self.folder / kind, f"lacks a file for frame {name}")
        world_from_cam = as_pose(
            self._poses[index],
            self._poses_path,
            layout=self.pose_layout,
            direction=self.pose_direction,
            axes=self.pose_axes,
        )
        depth = self._depth(depth_path)
        if self._registration is not None:
            depth = self._registration(depth)
            world_from_cam = world_from_cam @ self._registration.depth_from_colour
        rgb, has_flow = self._rgbs.get(name), name in self._flows and index > 0
        return Frame(
            name=name,
            source=depth_path if rgb is None else rgb,
            world_from_cam=world_from_cam,
            K=self.K,
            depth=depth,
            rgb=None if rgb is None else read_rgb(rgb),
            timestamp_s=None if self._times is None else float(self._times[index]),
            raw=self._flow(self._flows[name]) if has_flow else None,
            raw_since=self._depths[index - 1].stem if has_flow else None,
        )

    def _depth(self, path: Path) -> NDArray[np.float32]:
        stored = read_depth(path, self.depth_unit_m, self._camera.size)
        K = torch.from_numpy(self._camera.K).float() if self.depth_kind == "ray_length" else None
        depth = adapt_depth(
            torch.from_numpy(stored)[None],
            self.depth_kind,
            K=K,
            near_m=self.near_m,
            far_m=self.far_m,
        )
        return depth[0].numpy()

    def _flow(self, path: Path) -> NDArray[np.float32]:
        flow = read_kitti_flow(path) if path.suffix.lower() == ".png" else read_flo(path)
        adapted = adapt_flow(
            torch.from_numpy(flow),
            direction=self.flow_direction,
            grid=self.flow_grid,
            channels=self.flow_channels,
        )
        return adapted.numpy()

    def _by_stem(self, kind: str, suffixes: tuple[str, ...]) -> dict[str, Path]:
        folder = self.folder / kind
        if not folder.is_dir():
            return {}
        return {path.stem: path for path in list_files(folder, suffixes)}

    def _timestamps(self) -> NDArray[np.float64] | None:
        path = self.folder / "timestamps.txt"
        if not path.is_file():
            return None
        times = read_table(path, [1])[:, 0]
        if len(times) != len(self):
            raise SequenceError(path, f"has {len(times)} times for {len(self)} frames")
        check_ascending(path, times)
        return times
