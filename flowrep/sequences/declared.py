"""Recordings whose files and conventions are declared in a YAML file, see conf/format/."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import KW_ONLY, dataclass
from glob import escape
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from flowrep import geometry
from flowrep.sequences import calibration, files
from flowrep.sequences.calibration import as_pose, camera_matrix
from flowrep.sequences.recording import Frame, Pose, Recording, SequenceError
from flowrep.sequences.video import VIDEOS, VideoPictures

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
LeftOut = dict[str, NDArray[np.bool_]]  # frames by why they are left out

_POSE_OPTIONS = "layout", "direction", "axes"
PLAY_BACKWARDS = (
    "its flow leads to the next frame: format.backwards=true plays it from the last frame to the "
    "first, where that is the previous one"
)


@dataclass(eq=False)
class DeclaredRecording(Recording):
    """A folder of numbered or time-stamped pictures and depth maps, and of tables of numbers.

    `conf/format/frames.yaml` explains all options and sets those of the plain layout.
    `open_recording` reads it and the other formats, which state what differs.
    """

    folder: Path
    _: KW_ONLY
    rgb: str | None
    depth: str
    confidence: str | None
    flow: str | None
    flow_mask: str | None
    poses: str | None
    times: str | None
    intrinsics: str | Sequence[float]
    depth_intrinsics: str | Sequence[float] | None
    colour_from_depth: Sequence[float] | None
    scene: str | int | None
    camera: str | int | None
    render: str | None
    depth_by: Literal["name", "order", "time"]
    rows_by: Literal["order", "number", "time", "name"]
    key_column: int
    names: str | None
    rows_where: Sequence[int | str] | None
    pose_columns: Sequence[int] | None
    intrinsics_columns: Sequence[int] | None
    time_unit_s: float
    tolerance_s: float
    interpolate: bool
    pose_offset_s: float
    pose_lag_frames: int
    leave_out: Sequence[str]
    backwards: bool
    pose_layout: geometry.PoseLayout
    pose_direction: geometry.PoseDirection
    pose_axes: geometry.CameraAxes
    pose_unit_m: float
    marker_from_cam: Sequence[float] | None
    first_pixel_centre: float
    distortion: Sequence[float]
    lens: calibration.Lens
    resize_rgb: bool
    depth_unit_m: float | None
    depth_kind: geometry.DepthKind
    near_m: float | None
    far_m: float | None
    baseline_m: float | None
    depth_coding: files.DepthCoding | None
    depth_missing: Sequence[int]
    depth_no_surface: int | None
    depth_inf: Literal["no_surface", "missing"]
    min_confidence: int
    flow_coding: files.FlowCoding
    flow_to: Literal["previous", "next"]
    flow_direction: geometry.Direction
    flow_channels: geometry.Channels

    def __post_init__(self) -> None:
        self.folder = Path(self.folder)
        if self.depth_unit_m is not None and not self.depth_unit_m > 0:
            raise ValueError(f"depth_unit_m must be positive, got {self.depth_unit_m}")
        self.has_flow, self.no_flow = self._flow_fits()
        depths, depth_times_s = self._listing(self.depth, "map")
        listed, times_s = depths, depth_times_s
        self._video: VideoPictures | None = None
        self._rgbs: list[Path] | None = None
        if self.rgb is not None:
            rgb = self._path(self.rgb)
            if rgb.suffix.lower() in VIDEOS:
                self._video = VideoPictures(rgb)
            elif rgb.parent.is_dir() or not self.has_flow:
                listed, times_s = self._listing(self.rgb, "picture")
                self._rgbs = [*listed.values()]
        self._names, self._times_s = [*listed], times_s
        left_out = self._match_depth(depths, depth_times_s)
        if self.times is not None and self._exists(self.times):
            # Rows in the frames' order hold a time alone; others begin with one.
            columns = None if self.rows_by == "order" else (0, 1)
            table, (rows, _), _ = self._rows(self.times, columns)
            if table.shape[1] > 1:
                says = f"has {table.shape[1]} numbers in a row, expected one: seconds, with a point"
                raise SequenceError(self._path(self.times), says)
            self._times_s = table[rows, 0] * self.time_unit_s
            left_out["without a time"] = rows < 0
        left_out |= self._read_poses() | self._read_intrinsics()
        self.has_flow, self.no_flow = self._flow_fits()  # now that the lens is known
        if unknown := {*self.leave_out} - {*self._names}:
            raise SequenceError("leave_out", f"names frame {min(unknown)}, which doesn't exist")
        left_out["in format.leave_out"] = np.isin(self._names, list(self.leave_out))
        self._choose(left_out)
        self._made: dict[Any, tuple[Any, Any]] = {}
        unit_m = self.depth_unit_m or files.stored_depth(self._depths[0], self.depth_coding)[1]
        named = "pose_direction", "pose_axes", "depth_kind", "flow_direction", "flow_channels"
        self.conventions = {name: getattr(self, name) for name in named}
        self.conventions |= {"depth_unit_m": str(unit_m)}

    # Which files there are.

    def _path(self, pattern: str, **words: str) -> Path:
        """Returns a pattern's path; `*` stays."""
        given: dict[str, Any] = {n: getattr(self, n) for n in ("scene", "camera", "render")} | words
        for word in re.findall(r"{(\w+)}", pattern):
            if given.get(word) is None:
                raise SequenceError(f"format.{word}", f"needs a value, for {pattern}")
        return self.folder / re.sub(r"{(\w+)}", lambda word: str(given[word[1]]), pattern)

    def _file(self, pattern: str, kind: str, name: str, **words: str) -> Path:
        path = self._path(pattern, **words)
        return files.with_suffix(path.with_name(path.name.replace("*", name)), kind)

    def _exists(self, pattern: str) -> bool:
        path = self._path(pattern.partition(":")[0], next="*")
        name = escape(path.name).replace("[*]", "*")
        return path.parent.is_dir() and any(path.parent.glob(name))

    def check_files(self, options: Collection[str]) -> None:
        """Raises SequenceError if a file that one of these options names doesn't exist.

        They are the options that the user gave: a file that only the format names may be absent.
        """
        for option in ("poses", "times", "flow", "flow_mask"):
            pattern = getattr(self, option)
            if option in options and pattern is not None and not self._exists(pattern):
                path = self._path(pattern, next="*")
                raise SequenceError(f"format.{option}", f"there is no file {path}")

    def _flow_fits(self) -> tuple[bool, str]:
        """Returns whether the recorded flow can be used, and if not, why."""
        if self.flow is None:
            return False, self.no_flow
        if (self.flow_to == "next") != self.backwards:
            played = "its flow leads to the previous frame: use format.backwards=false"
            return False, played if self.backwards else PLAY_BACKWARDS
        if self.distortion:
            return False, "its flow is that of distorted pictures: use flow=estimated"
        return self._exists(self.flow), f"no such file: {self._path(self.flow, next='*')}"

    def _listing(self, pattern: str, kind: str) -> tuple[dict[str, Path], Floats | None]:
        """Returns files by the names of their frames, and their times if these are needed."""
        path, is_timed = self._path(pattern), "time" in (self.depth_by, self.rows_by)
        try:
            if "*" in pattern:
                found = files.find_files(path, kind)
                times = [float(name) for name in found if is_timed]
            else:
                lines = [line.split(maxsplit=1) for line in files.read_lines(path)]
                found = {Path(name).stem: self.folder / name for _, name in lines}
                times = [float(time) for time, _ in lines]
                if len(found) < len(times):
                    raise ValueError("two pictures have the same name")
        except (ValueError, FileNotFoundError, NotADirectoryError) as error:
            remedy = f"give the folder whose {path.name} has '<time> <file>' in each line"
            says = "is missing" if isinstance(error, OSError) else error
            raise SequenceError(path, f"{says}: {remedy}, or its format=") from None
        if not found:
            used = (self.rgb, self.depth, self.flow, self.poses, self.intrinsics)
            layout = ", ".join(name for name in used if isinstance(name, str))
            raise SequenceError(path, f"no such files: give a folder with {layout}, or its format=")
        if not times:
            return found, None
        return found, _ascending(path, np.array(times) * self.time_unit_s)

    # How files and rows belong together.

    def _match_depth(self, depths: dict[str, Path], times_s: Floats | None) -> LeftOut:
        """Finds the depth map of each frame; returns the frames that have none."""
        if self.depth_by == "time" and self._times_s is not None and times_s is not None:
            rows = nearest(times_s, self._times_s, self.tolerance_s)
            # Two pictures may have the same nearest depth map; it belongs to the nearer picture.
            frames = nearest(self._times_s, times_s, self.tolerance_s)
            self._depths = [[*depths.values()][row] for row in rows]
            lacking = (rows < 0) | (frames[rows] != np.arange(len(rows)))
            return {f"without depth within {self.tolerance_s} s": lacking}
        by_order = self.depth_by == "order"
        ours, theirs = (range(len(x)) if by_order else x for x in (self._names, depths))
        if unpaired := {*ours} ^ {*theirs}:
            lacks = self.rgb if min(unpaired) in theirs else self.depth
            raise SequenceError(
                self._path(lacks or "").parent, f"has no file for frame {min(unpaired)}"
            )
        self._depths = [dict(zip(theirs, depths.values()))[key] for key in ours]
        return {}

    def _rows(self, pattern: str, columns: Sequence[int] | None) -> tuple[Floats, Indices, Floats]:
        """Returns a table's columns, each frame's row before and after it, and the share between.

        The rows are `[2, frames]`, -1 for none; without interpolation they are the same.
        """
        path, by = self._path(pattern), self.rows_by
        keys: Any = None  # None: the rows are in the frames' order
        if "*" in pattern.partition(":")[0]:
            paths = [self._file(pattern, "numbers", name) for name in self._names]
            each = [files.read_table(path)[0].ravel() for path in paths]
            for path, numbers in zip(paths, each):
                if len(numbers) != len(each[0]):
                    raise SequenceError(path, f"has {len(numbers)} numbers, others {len(each[0])}")
            table = np.stack(each)
        else:
            in_rows = by == "name" and self.names is None
            table, keys = files.read_table(path, self.key_column if in_rows else None)
            if self.rows_where is not None:
                try:
                    column, value = map(str, self.rows_where)
                    wanted = int(column), float(self._path(value).name)
                except ValueError as error:
                    says = f"is [column, number]: {error}"
                    raise SequenceError("format.rows_where", says) from None
                table = table[_column(path, table, wanted[0]) == wanted[1]]
            if by == "order":
                keys = None
            elif by != "name":
                keys = _column(path, table, self.key_column)
            elif self.names is not None:
                keys = np.array(files.read_json(self._path(self.names)), str).ravel()
        after_key = 0 if keys is None or by == "name" else self.key_column + 1
        first, end = columns or (after_key, table.shape[1])
        if not len(table) or not first < end <= table.shape[1]:
            size = f"{len(table)} rows of {table.shape[1]}"
            raise SequenceError(path, f"has {size} numbers, expected {max(end, first + 1)}")
        rows: Any = np.arange(len(self._names))
        share = np.zeros(len(rows))
        if keys is None:
            if len(table) != len(rows):
                raise SequenceError(path, f"has {len(table)} rows for {len(rows)} frames")
        elif by == "time" and self._times_s is not None:
            times_s = _ascending(path, keys * self.time_unit_s) + self.pose_offset_s
            if self.interpolate:
                *rows, share = between(times_s, self._times_s, self.tolerance_s)
            else:
                rows = nearest(times_s, self._times_s, self.tolerance_s)
        else:
            key_of = _plain if by == "name" else _number
            row_of = {_plain(key) if by == "name" else key: row for row, key in enumerate(keys)}
            if len(keys) != len(table):
                raise SequenceError(path, f"has {len(table)} rows, and {len(keys)} {by}s")
            if len(row_of) < len(table) or (by != "name" and not np.isfinite(keys).all()):
                says = f"has two rows with the same {by}, or one that is nan or inf"
                raise SequenceError(path, f"{says}; select rows with format.rows_where")
            rows = np.array([row_of.get(key_of(name), -1) for name in self._names])
        return table[:, first:end], np.broadcast_to(rows, (2, len(self._names))), share

    def _read_poses(self) -> LeftOut:
        self.has_poses = self.poses is not None and self._exists(self.poses)
        if self.poses is None or not self.has_poses:
            return {}
        path = self._path(self.poses)
        numbers, rows, share = self._rows(self.poses, self.pose_columns)
        options: Any = {name: getattr(self, f"pose_{name}") for name in _POSE_OPTIONS}
        poses = as_pose(numbers, path, check=False, **options)
        lost = ~np.isfinite(poses).all((1, 2)) | (poses[:, :3, :3] == 0).all((1, 2))
        if not lost.all():
            numbers[lost] = numbers[~lost][0]  # so that errors name the wrong row
            poses = as_pose(numbers, path, **options)
            poses[:, :3, 3] *= self.pose_unit_m
            if self.marker_from_cam is not None:
                fixed = "xyz_xyzw" if len(self.marker_from_cam) == 7 else "matrix"
                marker = np.array(self.marker_from_cam)
                poses @= as_pose(marker, "marker_from_cam", layout=fixed)
        late = rows + max(-len(lost), min(self.pose_lag_frames, len(lost)))
        lacking = ((rows < 0) | (late < 0) | (late >= len(lost))).any(0)
        before, after = np.where(lacking, 0, late)
        is_lost = ~lacking & (lost[before] | lost[after])
        if not lost.all():
            self._poses = poses[before]
            if self.interpolate:
                self._poses = [*map(interpolated_pose, poses[before], poses[after], share)]
        near = f" within {self.tolerance_s} s" if self.rows_by == "time" else ""
        return {f"without a pose{near}": lacking, f"lost (nan, inf, 0) in {path.name}": is_lost}

    def _read_intrinsics(self) -> LeftOut:
        """Reads the numbers of K, and of depth's camera if it is another."""
        self._size = None
        source = self._path(self.intrinsics) if isinstance(self.intrinsics, str) else "intrinsics"
        if isinstance(self.intrinsics, str) and self.intrinsics.endswith(calibration.FILES):
            camera = calibration.read_camera(self._path(self.intrinsics))
            self._size = camera.height, camera.width  # of the camera of K
            self.intrinsics, self.first_pixel_centre = camera.numbers, 0.5
            if not self.distortion:
                self.distortion, self.lens = camera.distortion, camera.lens
        lacking, given = np.zeros(len(self._names), dtype=bool), self.intrinsics
        if isinstance(given, str) and ("*" in given or self.intrinsics_columns is not None):
            numbers, (rows, _), _ = self._rows(given, self.intrinsics_columns)
            numbers, lacking = numbers[rows], rows < 0
        else:
            numbers = self._numbers_in(given)
        camera_matrix(numbers[0], (2, 2), self.first_pixel_centre, source)  # or an error, early
        self._K_numbers = numbers.repeat(len(lacking) // len(numbers), axis=0)
        depth, self._depth_numbers = self.depth_intrinsics, None
        if depth is not None:
            self._depth_numbers = self._numbers_in(depth)
            K = camera_matrix(self._depth_numbers, (2, 2), self.first_pixel_centre)
            geometry.check_intrinsics("format.depth_intrinsics", torch.from_numpy(K))
        shift = np.array(self.colour_from_depth or 3 * [0.0])
        if len(shift) == 3:
            shift = np.column_stack([np.eye(3), shift]).ravel()
        self._colour_from_depth = as_pose(shift, "colour_from_depth")
        if depth is None and np.any(self._colour_from_depth != np.eye(4)):
            raise SequenceError("colour_from_depth", "needs format.depth_intrinsics, too")
        return {"without intrinsics": lacking}

    def _numbers_in(self, given: str | Sequence[float]) -> Floats:
        table = files.read_table(self._path(given))[0] if isinstance(given, str) else given
        return np.array(table, np.float64).reshape(1, -1)

    def _choose(self, left_out: LeftOut) -> None:
        """Numbers the remaining frames, in the order in which they are read."""
        kept, notes = np.ones(len(self._names), dtype=bool), []
        for why, frames in left_out.items():
            kept &= ~frames
            if frames.any():
                count = f"{frames.sum()} of {len(kept)} frames are left out"
                notes.append(f"{count}, {why}: {', '.join(np.array(self._names)[frames][:3])}")
        if not kept.any():
            remedy = "raise format.tolerance_s, or set format.poses=null"
            raise SequenceError(self.folder, f"{'; '.join(notes)}; none is left: {remedy}")
        if self.distortion:
            notes.append("pictures and depth are undistorted")
        self._order = np.flatnonzero(kept)[:: -1 if self.backwards else 1]
        self.count, self.notes = len(self._order), tuple(notes)
        self._clips = np.cumsum(~kept) * self.has_flow  # its own flow does not skip a frame
        numbers = np.array([float(_number(name)) for name in self._names])
        self._positions = positions(numbers if self._times_s is None else self._times_s)
        # Numbers tell which frame is missing, even if the times between frames vary.
        are_numbers = (np.diff(numbers) > 0).all() and not any("." in name for name in self._names)
        self._numbers = positions(numbers) if are_numbers else self._positions

    # The frames.

    def _read(self, index: int) -> Frame:
        i = int(self._order[index])
        name, source, raw, since = self._names[i], self._depths[i], None, None
        rgb: Any = None
        if self._rgbs is not None:
            source = self._rgbs[i]
            rgb = files.read_rgb(source)
        elif self._video is not None:
            number = _number(name) if self.rows_by == "number" else i
            rgb, source = self._video[number], self._video.path
        depth = self._stored_depth(i)
        size: tuple[int, ...] = depth.shape if rgb is None else rgb.shape[:2]
        of_K = self._size or size
        if of_K != size and not (self.resize_rgb and of_K == depth.shape):
            says = f"has {list(size)} rows and columns, intrinsics.json says {list(of_K)}"
            raise SequenceError(source, says)
        K = K_depth = camera_matrix(self._K_numbers[i], of_K, self.first_pixel_centre)
        if self.resize_rgb and rgb is not None:
            (height, width), size = of_K, depth.shape
            K = K_depth = np.diag([size[1] / width, size[0] / height, 1.0]) @ K
            rgb = cv2.resize(rgb, size[::-1], interpolation=cv2.INTER_AREA)
        if self._depth_numbers is not None:
            K_depth = camera_matrix(self._depth_numbers, depth.shape, self.first_pixel_centre)
        options: Any = {name: getattr(self, name) for name in ("near_m", "far_m", "baseline_m")}
        if self.depth_kind in ("ray_length", "disparity"):
            options["K"] = torch.from_numpy(K_depth).float()
        stored = torch.from_numpy(depth)[None]
        depth = geometry.adapt_depth(stored, self.depth_kind, **options)[0].numpy()
        pose = self._poses[i] if self.has_poses else None
        if self._depth_numbers is not None:
            register = self._once(
                calibration.Registration, K_depth, K, self._colour_from_depth, size
            )
            depth = register(depth)
            if pose is not None:
                pose = pose @ register.depth_from_colour
        if self.distortion:
            rectify = self._once(calibration.Undistortion, K, self.distortion, self.lens, size)
            rgb = None if rgb is None else rectify(rgb)
            depth = rectify(depth, nearest=True) if self._depth_numbers is None else depth
        if self.flow is not None and self.has_flow and index > 0:
            other = i + 1 if self.backwards else i - 1
            raw = self._raw(self.flow, name, self._names[other])
            is_next = abs(self._numbers[i] - self._numbers[other]) == 1
            since = self._names[other] if is_next else None
        time_s = None if self._times_s is None else float(self._times_s[i])
        position: Any = {"clip": int(self._clips[i]), "position": int(self._positions[i])}
        return Frame(name, source, pose, K, depth, rgb, time_s, raw, since, **position)

    def _once(self, make: Any, *arguments: Any) -> Any:
        """Returns `make` of the arguments, and the same object until they change."""
        made = self._made.get(make)
        if made is None or not all(map(np.array_equal, made[0], arguments)):
            made = self._made[make] = arguments, make(*arguments)
        return made[1]

    def _stored_depth(self, i: int) -> NDArray[np.float32]:
        path, codes = self._depths[i], (self.depth_missing, self.depth_no_surface)
        depth = files.read_depth(path, self.depth_unit_m, *codes, self.depth_coding)
        if self.depth_inf == "missing":
            depth[np.isinf(depth)] = np.nan
        if self.confidence is not None:
            trust = files.read_array(self._file(self.confidence, "map", self._names[i]))
            if trust.shape != depth.shape:
                raise SequenceError(path, f"and its confidence differ in size: {list(trust.shape)}")
            depth[trust < self.min_confidence] = np.nan
        return depth

    def _raw(self, pattern: str, name: str, other: str) -> files.FlowMap:
        stored = files.read_flow(self._file(pattern, "flow", name, next=other), self.flow_coding)
        # If it is read backwards, the next frame is the previous one.
        is_forward = (self.flow_direction == "forward") != (self.flow_to == "next")
        options: Any = {"grid": "current", "channels": self.flow_channels}
        options |= {"direction": "forward" if is_forward else "backward"}
        raw: files.FlowMap = geometry.adapt_flow(torch.from_numpy(stored), **options).numpy()
        if self.flow_mask is not None:
            mask = self._file(self.flow_mask, "map", name, next=other)
            if mask.is_file():
                unknown = files.read_array(mask)
                if unknown.shape != raw.shape[1:]:
                    raise SequenceError(mask, f"has the size {list(unknown.shape)}, flow another")
                raw[:, unknown != 0] = np.nan
        return raw


def positions(values: Floats) -> Indices:
    """Returns the number that each frame would have if none were missing, from times or numbers."""
    steps = np.diff(values)
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else np.inf
    return np.append(0, np.rint(steps / usual).clip(1).cumsum()).astype(int)


def _number(name: str) -> int:
    digits = re.search(r"[0-9]+$", name)
    return int(digits[0]) if digits else -1


def _plain(name: str) -> str:
    """Returns a frame's name without folder, suffix and leading zeros: images/007.png is 7."""
    stem = Path(name).stem if Path(name).suffix.lower() in files.PICTURES else Path(name).name
    return stem.lstrip("0") or "0"


def _column(path: Path, table: Floats, number: int) -> Floats:
    if not 0 <= number < table.shape[1]:
        raise SequenceError(path, f"has {table.shape[1]} columns, and none of number {number}")
    column: Floats = table[:, number]
    return column


def _ascending(path: Path, times_s: Floats) -> Floats:
    if not (np.diff(times_s) >= 0).all():  # nan compares False
        raise SequenceError(path, "times go backwards, or are not numbers")
    return times_s


def nearest(times_s: Floats, wanted_s: Floats, tolerance_s: float) -> Indices:
    """Returns the index of the time nearest to each wanted one, -1 if none is near enough."""
    after = np.searchsorted(times_s, wanted_s).clip(0, len(times_s) - 1)
    before = (after - 1).clip(0)
    gap_after, gap_before = (np.abs(times_s[index] - wanted_s) for index in (after, before))
    closest = np.where(gap_before <= gap_after, before, after)
    return np.where(np.minimum(gap_before, gap_after) <= tolerance_s, closest, -1)


def between(
    times_s: Floats, wanted_s: Floats, tolerance_s: float
) -> tuple[Indices, Indices, Floats]:
    """Returns indices before and after each wanted time, -1 if too far, and the share between."""
    after = np.searchsorted(times_s, wanted_s).clip(0, len(times_s) - 1)
    before = np.where(times_s[after] == wanted_s, after, after - 1)
    gaps = wanted_s - times_s[before], times_s[after] - wanted_s
    inside = (before >= 0) & (np.minimum(*gaps) >= 0) & (np.maximum(*gaps) <= tolerance_s)
    span = np.maximum(times_s[after] - times_s[before], 1e-9)
    return np.where(inside, before, -1), after, gaps[0] / span


def interpolated_pose(before: Pose, after: Pose, share: float) -> Pose:
    """Returns the pose at a share of the way, for constant velocity and angular velocity."""
    axis_angle, _ = cv2.Rodrigues(before[:3, :3].T @ after[:3, :3])
    pose = np.eye(4)
    pose[:3, :3] = before[:3, :3] @ cv2.Rodrigues(share * axis_angle)[0]
    pose[:3, 3] = (1 - share) * before[:3, 3] + share * after[:3, 3]
    return pose
