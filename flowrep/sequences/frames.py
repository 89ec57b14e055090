"""The plain layout, which any recording can be written in, and a ZED's, which has its files too."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from flowrep import geometry
from flowrep.sequences import files
from flowrep.sequences.calibration import Registration, as_pose, read_cameras, read_poses
from flowrep.sequences.recording import Frame, Recording, SequenceError


class Frames(Recording):
    """A folder with `depth/`, `intrinsics.json`, `rgb/`, `flow/` or both, and `poses.txt`.

    Files of one frame share their name up to the suffix; docs/factorize.md shows all. Without
    `poses.txt` the camera's motion has to be estimated.

    Args:
        pose_layout: see `flowrep.geometry.adapt_pose`, as for `pose_direction` and `pose_axes`.
        depth_unit_m: the length of a stored 1, metres; None is 0.001 in a .png and 1 in a .npy.
        depth_kind: see `flowrep.geometry.adapt_depth`, as for `near_m` and `far_m`.
        flow_direction: see `flowrep.geometry.adapt_flow`, as for `flow_grid` and `flow_channels`.
    """

    no_flow = "it has no folder flow/: use flow=estimated"

    def __init__(
        self,
        folder: str | Path,
        *,
        pose_layout: geometry.PoseLayout = "matrix",
        pose_direction: geometry.PoseDirection = "camera_to_world",
        pose_axes: geometry.CameraAxes = "opencv",
        depth_unit_m: float | None = None,
        depth_kind: geometry.DepthKind = "z",
        near_m: float | None = None,
        far_m: float | None = None,
        flow_direction: geometry.Direction = "forward",
        flow_grid: geometry.Grid = "current",
        flow_channels: geometry.Channels = "uv",
    ) -> None:
        if depth_unit_m is not None and not depth_unit_m > 0:
            raise ValueError(f"depth_unit_m is positive, got {depth_unit_m}")
        self.folder, self.depth_unit_m = Path(folder), depth_unit_m
        self._depth_options: dict[str, Any] = {"kind": depth_kind, "near_m": near_m, "far_m": far_m}
        self._flow_options: dict[str, Any] = {
            "direction": flow_direction, "grid": flow_grid, "channels": flow_channels,
        }  # fmt: skip
        self._depths = files.list_files(self.folder / "depth", files.DEPTH_FILES)
        self.count, names = len(self._depths), [path.stem for path in self._depths]
        self._rgbs = self._by_stem("rgb", files.PICTURES, names)
        # The first frame has no flow since the frame before.
        self._flows = self._by_stem("flow", (".flo", ".png"), names[1:])
        if not self._rgbs and not self._flows:
            raise SequenceError(self.folder, "has neither rgb/ nor flow/: one of them is needed")
        self.has_flow = bool(self._flows)
        path, times = self.folder / "poses.txt", self.folder / "timestamps.txt"
        self.has_poses = path.is_file()
        if self.has_poses:
            options: Any = {"layout": pose_layout, "direction": pose_direction, "axes": pose_axes}
            self._poses = read_poses(path, len(self), **options)
        self._times = files.read_table(times, 1)[:, 0] if times.is_file() else None
        if self._times is not None and len(self._times) != len(self):
            raise SequenceError(times, f"has {len(self._times)} times for {len(self)} frames")
        path = self.folder / "intrinsics.json"
        self._camera = read_cameras(path)
        self._registration, self.K = None, self._camera.K
        if colour := self._camera.colour:
            extrinsics, self.K = as_pose(np.ravel(colour.colour_from_depth), path), colour.K
            self._registration = Registration(self._camera.K, self.K, extrinsics, colour.size)
        unit_m = depth_unit_m or (1.0 if self._depths[0].suffix.lower() == ".npy" else 0.001)
        self.conventions = {
            "pose_direction": pose_direction, "pose_axes": pose_axes,
            "depth_kind": depth_kind, "depth_unit_m": str(unit_m),
            "flow_direction": flow_direction, "flow_channels": flow_channels,
        }  # fmt: skip

    def _by_stem(self, kind: str, suffixes: Sequence[str], names: Sequence[str]) -> dict[str, Path]:
        folder = self.folder / kind
        there = files.list_files(folder, suffixes) if folder.is_dir() else []
        found = {path.stem: path for path in there}
        if found and (lacking := [name for name in names if name not in found]):
            raise SequenceError(folder, f"lacks a file for frame {lacking[0]}")
        if others := found.keys() - {path.stem for path in self._depths}:
            raise SequenceError(self.folder / "depth", f"lacks a file for {kind}/{min(others)}")
        return found

    def _read(self, index: int) -> Frame:
        depth_path = self._depths[index]
        name = depth_path.stem
        world_from_cam = self._poses[index] if self.has_poses else None
        stored = files.read_depth(depth_path, self._camera.size, self.depth_unit_m)
        is_ray = self._depth_options["kind"] == "ray_length"
        K = torch.from_numpy(self._camera.K).float() if is_ray else None
        z = geometry.adapt_depth(torch.from_numpy(stored)[None], K=K, **self._depth_options)
        depth = z[0].numpy()
        if self._registration is not None:
            depth = self._registration(depth)
            if world_from_cam is not None:
                world_from_cam = world_from_cam @ self._registration.depth_from_colour
        raw = since = None
        if self.has_flow and index > 0:
            path = self._flows[name]
            read = files.read_kitti_flow if path.suffix.lower() == ".png" else files.read_flo
            raw = geometry.adapt_flow(torch.from_numpy(read(path)), **self._flow_options).numpy()
            since = self._depths[index - 1].stem
        source = self._rgbs.get(name, depth_path)
        rgb = files.read_rgb(source) if self._rgbs else None
        time_s = None if self._times is None else float(self._times[index])
        flow: Any = {"raw": raw, "raw_since": since}
        return Frame(name, source, world_from_cam, self.K, depth, rgb, time_s, **flow)


class Zed(Recording):
    """A folder exported from a ZED's SVO file.

    It holds `left000000.png`, `depth000000.png` (or `.npy`), the rectified left camera's
    `intrinsics.json`, as in `Frames`, and its poses in `poses.txt`, a line `tx ty tz qx qy qz qw`
    for each picture; without it, the motion has to be estimated.

    Args:
        pose_axes: the coordinate system of the exported poses: `"opencv"` for the SDK's
            IMAGE, `"opengl"` for RIGHT_HANDED_Y_UP, `"x_forward_z_up"` for RIGHT_HANDED_Z_UP_X_FWD.
    """

    def __init__(self, folder: str | Path, *, pose_axes: geometry.CameraAxes = "opencv") -> None:
        self.folder = Path(folder)
        self._pictures = files.list_files(self.folder, files.PICTURES, "left")
        depths = files.list_files(self.folder, files.DEPTH_FILES, "depth")
        self._depths = {path.stem.removeprefix("depth"): path for path in depths}
        self.count = len(self._pictures)
        path, self.conventions = self.folder / "poses.txt", {"pose_axes": pose_axes}
        self.has_poses = path.is_file()
        if self.has_poses:
            self._poses = read_poses(path, len(self), axes=pose_axes)
        self._camera = read_cameras(self.folder / "intrinsics.json")

    def _read(self, index: int) -> Frame:
        picture = self._pictures[index]
        number = picture.stem.removeprefix("left")
        if number not in self._depths:
            raise SequenceError(self.folder, f"lacks depth{number} for {picture.name}")
        world_from_cam = self._poses[index] if self.has_poses else None
        depth = measured(files.read_depth(self._depths[number], self._camera.size))
        rgb = files.read_rgb(picture)
        return Frame(number, picture, world_from_cam, self._camera.K, depth, rgb)


def measured(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns a ZED's depth with nan where there is none: nan, -inf (too near), inf (too far)."""
    # Too far does not mean sky: the surface is at an unknown distance beyond the range.
    return np.where(np.isfinite(depth), depth, np.float32(np.nan))
