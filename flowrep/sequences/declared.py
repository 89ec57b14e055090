"""Recordings whose files and conventions are declared in a YAML file, see conf/format/."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field

from flowrep import geometry
from flowrep.config.options import Positive
from flowrep.sequences import calibration, files, matching
from flowrep.sequences.calibration import Matrix, as_pose, camera_matrix
from flowrep.sequences.matching import Floats, Indices, LeftOut, match_times
from flowrep.sequences.recording import Frame, Recording, SequenceError
from flowrep.sequences.video import VIDEOS, VideoPictures

Bounds = Annotated[Sequence[float | str], Field(min_length=2, max_length=2)]


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
    poses: str | Sequence[str] | None
    times: str | None
    intrinsics: str | Sequence[float]
    depth_intrinsics: str | Sequence[float] | None
    colour_from_depth: Sequence[float] | None
    scene: str | int | None
    camera: str | int | None
    render: str | None
    depth_by: Literal["name", "order", "time"]
    rows_by: Literal["order", "number", "time", "name"]
    key: int | str | None
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
    pose_unit_m: Positive
    marker_from_cam: Sequence[float] | None
    intrinsics_kind: calibration.IntrinsicsKind
    first_pixel_centre: float
    distortion: Sequence[float]
    lens: calibration.Lens
    resize_rgb: bool
    depth_unit_m: Positive | None
    depth_kind: geometry.DepthKind
    near_m: float | None
    far_m: float | None
    baseline_m: float | None
    depth_coding: files.DepthCoding | None
    depth_missing: Sequence[int]
    depth_no_surface: int | None
    depth_inf: Literal["no_surface", "missing"]
    min_confidence: int
    flow_range: Literal["size"] | Bounds
    flow_marks_unknown: bool
    flow_unit_px: Positive
    flow_to: Literal["previous", "next"]
    flow_direction: geometry.Direction
    flow_channels: geometry.Channels

    def __post_init__(self) -> None:
        self.folder = Path(self.folder)
        for word in ("scene", "camera", "render"):
            if getattr(self, word) is not None and f"{{{word}}}" not in str(vars(self)):
                raise SequenceError(f"format.{word}", "stands in no file's name of this format")
        options = "flow", "flow_mask", "times", "poses"
        self._flow, self._flow_mask, self._times, self._pose_files = map(self._sources, options)
        self._check_flow()
        left_out = self._find_frames() | self._read_times()
        left_out |= self._read_intrinsics() | self._read_poses()
        self._check_flow()  # now that the lens is known
        if unknown := {*self.leave_out} - {*self._names}:
            raise SequenceError("leave_out", f"names frame {min(unknown)}, which doesn't exist")
        left_out["in format.leave_out"] = np.isin(self._names, list(self.leave_out))
        self._choose(left_out)
        unit_m = self.depth_unit_m or files.stored_depth(self._depths[0], self.depth_coding)[1]
        if self.depth_unit_m is None and unit_m != 1 and self.depth_kind not in ("z", "ray_length"):
            says = f"needs a value: whole numbers of kind {self.depth_kind} have no usual unit"
            raise SequenceError("format.depth_unit_m", says)
        named = ["pose_layout", "pose_direction", "pose_axes", "depth_kind"]
        named += ["flow_direction", "flow_channels"]
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

    def _sources(self, option: str) -> list[str]:
        """Returns an option's files; none if they may be missing, by a `?`, and one is."""
        given = getattr(self, option)
        sources = [given] if isinstance(given, str) else [*(given or ())]
        for source in sources:
            path = self._path(source.rstrip("?").partition(":")[0], next="*")
            if any(files.alike(path)):
                continue
            if not source.endswith("?"):
                raise SequenceError(f"format.{option}", f"there is no file {path}")
            self.no_flow = f"no such file: {path}" if option == "flow" else self.no_flow
            return []
        return [source.rstrip("?") for source in sources]

    def _check_flow(self) -> None:
        """Sets whether recorded flow can be used, and if not, why."""
        is_reversed = (self.flow_to == "next") != self.backwards
        if self._flow and is_reversed:
            self.no_flow = f"its flow leads to the {self.flow_to} frame: " + (
                "format.backwards=true plays it from the last frame to the first, where that is "
                "the previous one" if self.flow_to == "next" else "use format.backwards=false"
            )  # fmt: skip
        elif self._flow and self.distortion:
            self.no_flow = "its flow is that of distorted pictures: use flow=estimated"
        self.has_flow = bool(self._flow) and not (is_reversed or self.distortion)

    def _find_frames(self) -> LeftOut:
        """Finds pictures and depth; returns the frames without depth."""
        depths, depth_times_s = self._listing(self.depth, "map")
        listed, self._times_s = depths, depth_times_s
        self._video: VideoPictures | None = None
        self._rgbs: list[Path] | None = None
        if self.rgb is not None:
            rgb = self._path(self.rgb)
            if rgb.suffix.lower() in VIDEOS:
                self._video = VideoPictures(rgb)
            elif rgb.parent.is_dir() or not self.has_flow:
                listed, self._times_s = self._listing(self.rgb, "picture")
                self._rgbs = [*listed.values()]
        self._names, found = [*listed], [*depths.values()]
        if self.depth_by == "time" and self._times_s is not None and depth_times_s is not None:
            (rows, _), _ = match_times(depth_times_s, self._times_s, self.tolerance_s)
            self._depths = [found[row] for row in rows]
            return {f"without depth within {self.tolerance_s} s": rows < 0}
        by_order = self.depth_by == "order"
        ours, theirs = (range(len(x)) if by_order else x for x in (self._names, depths))
        if unpaired := {*ours} ^ {*theirs}:
            lacks = self._path((self.rgb if min(unpaired) in theirs else self.depth) or "").parent
            raise SequenceError(lacks, f"has no file for frame {min(unpaired)}")
        self._depths = found if by_order else [depths[name] for name in self._names]
        return {}

    def _listing(self, pattern: str, kind: str) -> tuple[dict[str, Path], Floats | None]:
        """Returns files by the names of their frames, and their times if these are needed."""
        path, by_times = self._path(pattern), self.rows_by == "time" and not self._times
        is_timed = by_times or self.depth_by == "time"
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
            used = (self.rgb, self.depth, self.flow, self.intrinsics)
            layout = ", ".join(name.rstrip("?") for name in used if isinstance(name, str))
            raise SequenceError(path, f"no such files: give a folder with {layout}, or its format=")
        if not times:
            return found, None
        return found, _ascending(path, np.array(times) * self.time_unit_s)

    # Tables, and which rows belong to which frames.

    def _table(
        self, sources: Sequence[str], columns: Sequence[int] | None, by: str
    ) -> tuple[Floats, Indices, Floats]:
        """Returns a table's columns, each frame's row before and after it, and the share between.

        The rows are `[2, frames]`, -1 for none; without interpolation they are the same.
        """
        path, keys = self._path(sources[0]), None
        if "*" in sources[0].partition(":")[0]:  # a file per frame, whose numbers are its row
            if len(sources) > 1:
                raise SequenceError(path, f"is a file per frame, which can't join {sources[1:]}")
            paths = [self._file(sources[0], "numbers", name) for name in self._names]
            parts = [files.read_table(path)[0].ravel()[None] for path in paths]
            sizes = [part.shape[1] for part in parts]
            for path, size in zip(paths, sizes):
                if size != sizes[0]:
                    raise SequenceError(path, f"has {size} numbers, others {sizes[0]}")
            table = np.concatenate(parts)
        else:
            key = None if by == "order" else self.key
            at = key if isinstance(key, int) else None
            table, keys = files.read_table(path, at, named=by == "name")
            others = [files.read_table(self._path(source))[0] for source in sources[1:]]
            if any(len(other) != len(table) for other in others):
                raise SequenceError(path, f"has {len(table)} rows, {sources[1:]} another number")
            table = np.hstack([table, *others])
            if isinstance(key, str):
                keys = np.ravel(files.read_json(self._path(key)))
            elif key is None and by != "order":
                keys = np.arange(len(table))
        if self.rows_where is not None:
            try:
                column, value = map(str, self.rows_where)
                wanted = float(self._path(value).name)
                chosen = table[:, int(column)] == wanted
            except (ValueError, IndexError) as error:
                says = f"is [column, number], of {path}: {error}"
                raise SequenceError("format.rows_where", says) from None
            table, keys = table[chosen], None if keys is None else np.array(keys)[chosen]
        first, end = columns or (0, table.shape[1])
        if not len(table) or not 0 <= first < end <= table.shape[1]:
            size = f"{len(table)} rows of {table.shape[1]}"
            raise SequenceError(path, f"has {size} numbers, expected {max(end, first + 1)}")
        return table[:, first:end], *self._match(path, keys, len(table), by)

    def _match(self, path: Path, keys: Any, count: int, by: str) -> tuple[Indices, Floats]:
        """Returns the rows around each frame, and the share between; see `_table`."""
        rows = np.arange(len(self._names))
        if keys is None:
            if count != len(rows):
                raise SequenceError(path, f"has {count} rows for {len(rows)} frames")
        elif by == "time" and self._times_s is not None:
            stamps = np.asarray(keys, np.float64)  # which a JSON may hold as text
            times_s = _ascending(path, stamps * self.time_unit_s) + self.pose_offset_s
            options: Any = {"interpolate": self.interpolate}
            return match_times(times_s, self._times_s, self.tolerance_s, **options)
        else:
            as_key, key_of = (_bare_name, _bare_name) if by == "name" else (float, _number)
            row_of = {as_key(key): row for row, key in enumerate(keys)}
            if len(keys) != count:
                raise SequenceError(path, f"has {count} rows, and {len(keys)} {by}s")
            if len(row_of) < count or (by != "name" and not np.isfinite([*row_of]).all()):
                says = f"has two rows with the same {by}, or one that is nan or inf"
                raise SequenceError(path, f"{says}; select rows with format.rows_where")
            rows = np.array([row_of.get(key_of(name), -1) for name in self._names])
            if len(found := rows[rows >= 0]) > len({*found}):
                says = f"has one row for frames whose {by} is the same, such as {self._names[0]}"
                raise SequenceError(path, f"{says}: give format.rgb, in which * is the {by} alone")
        return np.stack([rows, rows]), np.zeros(len(rows))

    def _read_times(self) -> LeftOut:
        if not self._times:
            return {}
        # By times, other tables belong to frames, but not the table of the frames' times itself.
        by = "order" if self.rows_by == "time" else self.rows_by
        # Rows in the frames' order hold a time alone; others begin with one.
        table, (rows, _), _ = self._table(self._times, None if by == "order" else (0, 1), by)
        if table.shape[1] > 1:
            says = f"has {table.shape[1]} numbers in a row, expected one: seconds, with a point"
            raise SequenceError(self._path(self._times[0]), says)
        self._times_s = table[rows, 0] * self.time_unit_s
        return {"without a time": rows < 0}

    def _read_poses(self) -> LeftOut:
        self.has_poses = bool(self._pose_files)
        if not self.has_poses:
            return {}
        path = self._path(self._pose_files[0])
        numbers, rows, share = self._table(self._pose_files, self.pose_columns, self.rows_by)
        names = "layout", "direction", "axes"
        options: Any = {name: getattr(self, f"pose_{name}") for name in names}
        poses = as_pose(numbers, path, check=False, **options)
        lost = ~np.isfinite(poses).all((1, 2)) | (poses[:, :3, :3] == 0).all((1, 2))
        late = rows + max(-len(lost), min(self.pose_lag_frames, len(lost)))
        lacking = ((rows < 0) | (late < 0) | (late >= len(lost))).any(0)
        late = np.where(lacking, 0, late)
        if not lost.all():
            numbers[lost] = numbers[~lost][0]  # so that errors name the wrong row
            poses = as_pose(numbers, path, **options)
            poses[:, :3, 3] *= self.pose_unit_m
            poses @= calibration.fixed_pose(self.marker_from_cam, "marker_from_cam")
            if self._rig.colour_from_depth is not None:
                poses @= np.linalg.inv(self._rig.colour_from_depth)  # they are the depth camera's
            self._poses = matching.poses_between(poses, late, share)
        which = "on both sides" if self.interpolate else "of its own"
        near = f" {which} within {self.tolerance_s} s" if self.rows_by == "time" else ""
        is_lost = ~lacking & lost[late].any(0)
        return {f"without a pose{near}": lacking, f"lost (nan, inf, 0) in {path.name}": is_lost}

    def _read_intrinsics(self) -> LeftOut:
        """Reads the numbers of K, of its lens, and of depth's camera if it is another."""
        self._sizes: list[tuple[int, int]] | None = None
        given, rows = self.intrinsics, np.zeros(len(self._names), dtype=int)
        source: Any = self._path(given) if isinstance(given, str) else "intrinsics"
        if isinstance(given, str) and given.lower().endswith(calibration.FILES):
            by_name = calibration.read_cameras(source)
            cameras = [*by_name.values()]
            if len(cameras) > 1:
                (rows, _), _ = self._match(source, [*by_name], len(cameras), "name")
            self._sizes = [(cameras[row].height, cameras[row].width) for row in rows]
            numbers = np.array([camera.numbers(self.first_pixel_centre) for camera in cameras])
            if not self.distortion:
                self.distortion, self.lens = cameras[0].distortion, cameras[0].lens
        elif isinstance(given, str) and ("*" in given or self.intrinsics_columns is not None):
            numbers, (rows, _), _ = self._table([given], self.intrinsics_columns, self.rows_by)
        else:
            numbers = self._numbers_in(given)
        self._K_numbers = numbers[rows]
        self._camera(0, (2, 2), source)  # or an error, early
        self._depth_numbers = None
        pose: Any = calibration.fixed_pose(self.colour_from_depth, "colour_from_depth")
        if self.depth_intrinsics is not None:
            self._depth_numbers = self._numbers_in(self.depth_intrinsics)
            K = camera_matrix(self._depth_numbers, (2, 2), self.first_pixel_centre)
            geometry.check_intrinsics("format.depth_intrinsics", torch.from_numpy(K))
        elif np.any(pose != np.eye(4)):
            raise SequenceError("colour_from_depth", "needs format.depth_intrinsics, too")
        else:
            pose = None
        self._rig = calibration.Rig(self.distortion, self.lens, pose)
        return {"without intrinsics": rows < 0}

    def _numbers_in(self, given: str | Sequence[float]) -> Floats:
        table = files.read_table(self._path(given))[0] if isinstance(given, str) else given
        return np.array(table, np.float64).reshape(1, -1)

    def _choose(self, left_out: LeftOut) -> None:
        """Numbers the remaining frames, in the order in which they are read."""
        remedy = "raise format.tolerance_s, or set format.poses=null"
        kept, notes = matching.keep(self._names, left_out, self.folder, remedy)
        if self.distortion:
            notes.append("pictures and depth are undistorted")
        if self._video and self.rows_by != "number" and self._video.count > len(self._names):
            says = f"has {self._video.count} pictures for {len(self._names)} depth maps"
            notes.append(f"{self._video.path.name} {says}: the first ones are taken, in order")
        self._order = kept[:: -1 if self.backwards else 1]
        self.count, self.notes = len(kept), tuple(notes)
        # Recorded flow does not skip a frame, so that each gap begins a clip.
        self._clips = np.cumsum(~np.isin(range(len(self._names)), kept)) * self.has_flow
        numbers = np.array([float(_number(name)) for name in self._names])
        self._positions = matching.positions(numbers if self._times_s is None else self._times_s)
        # Numbers tell which frame is missing, even if the times between frames vary.
        are_numbers = (np.diff(numbers) > 0).all() and not any("." in name for name in self._names)
        self._numbers = matching.positions(numbers) if are_numbers else self._positions

    # The frames.

    def _frame(self, index: int) -> Frame:
        i = int(self._order[index])
        rgb, source = self._picture(i)
        depth = self._stored_depth(i)
        size = depth.shape if rgb is None else rgb.shape[:2]
        of_K = size if self._sizes is None else self._sizes[i]
        if of_K != size and not (self.resize_rgb and of_K == depth.shape):
            says = f"has {list(size)} rows and columns, intrinsics.json says {list(of_K)}"
            raise SequenceError(source, says)
        K = K_depth = self._camera(i, of_K)
        if self.resize_rgb and rgb is not None:
            scale = np.divide(depth.shape, of_K)
            K = K_depth = np.diag([*scale[::-1], 1.0]) @ K
            rgb = cv2.resize(rgb, depth.shape[::-1], interpolation=cv2.INTER_AREA)
        if self._depth_numbers is not None:
            K_depth = camera_matrix(self._depth_numbers, depth.shape, self.first_pixel_centre)
            depth = self._along_axis(depth, K_depth)
        rgb, depth = self._rig(rgb, depth, K, K_depth)
        if self._depth_numbers is None:  # once the lens is taken out, pixels see along K's rays
            depth = self._along_axis(depth, K)
        pose = self._poses[i] if self.has_poses else None
        time_s = None if self._times_s is None else float(self._times_s[i])
        position: Any = {"clip": int(self._clips[i]), "position": int(self._positions[i])}
        raw, since = self._raw(index)
        return Frame(self._names[i], source, pose, K, depth, rgb, time_s, raw, since, **position)

    def _camera(self, i: int, size: tuple[int, ...], source: object = "intrinsics") -> Matrix:
        options: Any = {"source": source, "kind": self.intrinsics_kind}
        return camera_matrix(self._K_numbers[i], size, self.first_pixel_centre, **options)

    def _picture(self, i: int) -> tuple[Any, Path]:
        """Returns a frame's picture, None if there are none, and the file that errors name."""
        if self._rgbs is not None:
            return files.read_rgb(self._rgbs[i]), self._rgbs[i]
        if self._video is not None:
            number = _number(self._names[i]) if self.rows_by == "number" else i
            return self._video[number], self._video.path
        return None, self._depths[i]

    def _stored_depth(self, i: int) -> NDArray[np.float32]:
        path, codes = self._depths[i], (self.depth_missing, self.depth_no_surface)
        depth = files.read_depth(path, self.depth_unit_m, *codes, self.depth_coding)
        if self.depth_inf == "missing":
            depth[np.isinf(depth)] = np.nan
        if self.confidence is not None:
            trust = self._mask(self.confidence, self._names[i], depth.shape)
            depth[trust < self.min_confidence] = np.nan
        return depth

    def _along_axis(self, depth: NDArray[np.float32], K: Matrix) -> NDArray[np.float32]:
        options: Any = {name: getattr(self, name) for name in ("near_m", "far_m", "baseline_m")}
        if self.depth_kind in ("ray_length", "disparity"):
            options["K"] = torch.from_numpy(K).float()
        along = geometry.adapt_depth(torch.from_numpy(depth)[None], self.depth_kind, **options)
        depth = along[0].numpy()
        return depth

    def _raw(self, index: int) -> tuple[files.FlowMap | None, str | None]:
        """Returns the recorded flow, and the frame from which it is measured if it exists."""
        if not self.has_flow or index == 0:
            return None, None
        i = int(self._order[index])
        other = i + 1 if self.backwards else i - 1
        name, words = self._names[i], {"next": self._names[other]}
        bounds: Any = self.flow_range
        if bounds != "size":
            bounds = [self._numbers_in(x).item() if isinstance(x, str) else x for x in bounds]
        path = self._file(self._flow[0], "flow", name, **words)
        stored = self.flow_unit_px * files.read_flow(path, bounds, self.flow_marks_unknown)
        # If it is read backwards, the next frame is the previous one.
        is_forward = (self.flow_direction == "forward") != (self.flow_to == "next")
        options: Any = {"grid": "current", "channels": self.flow_channels}
        options |= {"direction": "forward" if is_forward else "backward"}
        raw: files.FlowMap = geometry.adapt_flow(torch.from_numpy(stored), **options).numpy()
        for mask in self._flow_mask:
            raw[:, self._mask(mask, name, raw.shape[1:], **words) != 0] = np.nan
        is_next = abs(self._numbers[i] - self._numbers[other]) == 1
        return raw, self._names[other] if is_next else None

    def _mask(self, pattern: str, name: str, size: tuple[int, ...], **words: str) -> NDArray[Any]:
        """Returns a frame's confidence, or a mask, of this size."""
        mask = files.read_array(path := self._file(pattern, "map", name, **words))
        if mask.shape != size:
            raise SequenceError(path, f"has the size {list(mask.shape)}, its frame {list(size)}")
        return mask


def _number(name: str) -> int:
    digits = re.search(r"[0-9]+(?=\D*$)", name)  # the last ones, as in 0001_left
    return int(digits[0]) if digits else -1


def _bare_name(name: str) -> str:
    """Returns a frame's name without folder, suffix and leading zeros: images/007.png is 7."""
    stem = Path(name).stem if Path(name).suffix.lower() in files.PICTURES else Path(name).name
    return stem.lstrip("0") or "0"


def _ascending(path: Path, times_s: Floats) -> Floats:
    if not (np.diff(times_s) >= 0).all():  # nan compares False
        raise SequenceError(path, "times go backwards, or are not numbers")
    return times_s
