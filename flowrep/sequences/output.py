"""What a factorisation writes: the table, flow files, pictures, the video, the camera's path."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep import viz
from flowrep.files import append_rows, replace_text
from flowrep.sequences.factorization import FactorizedFrame, factorize_pair
from flowrep.sequences.files import FlowMap, write_flo, write_kitti_flow, write_picture
from flowrep.sequences.recording import Frame, Pose, SequenceError

FLOW_NAMES = ("raw", "ego", "obj")
_MOVING_SPREAD = 3.0
_TILE_PX = 480  # largest side of a tile of the video, so that two rows of three fit on a screen


@dataclass(eq=False)
class Output:
    """The folder of a job: `<path>.partial` while it runs, `<path>` once it is complete.

    Args:
        path: the folder, which must not exist yet.
        settings: of the job, written to `job.json`.
        flow_files: formats of flow files: any of "flo", "kitti" and "npz".
        pictures_every: the number of frames from one set of flow pictures to the next; 0 for none.
        scale_px: the flow that has full colour, by name.
        depth_range_m: the depth at the end of the video's colour scale.
        moving_px: the object flow above which a pixel may count as moving.
        masks: whether to write a mask of moving pixels for each frame.
        video_fps: None for no video.
    """

    path: Path
    settings: Mapping[str, Any]
    _: KW_ONLY
    flow_files: Sequence[str] = ("flo",)
    pictures_every: int = 10
    scale_px: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(FLOW_NAMES, 20.0))
    depth_range_m: float = 10.0
    moving_px: float = 1.0
    masks: bool = False
    video_fps: float | None = None

    def __post_init__(self) -> None:
        self.path = Path(self.path)
        self.partial = Path(f"{self.path}.partial")
        if self.partial.is_dir() and {file.name for file in self.partial.iterdir()} <= {"job.json"}:
            shutil.rmtree(self.partial)  # of a job that was killed before its first frame
        for folder in (self.path, self.partial):
            if os.path.lexists(folder):
                raise SequenceError(folder, "exists already; remove it, or give another output")
        self.rows: list[dict[str, Any]] = []
        self._poses: dict[str, Pose] = {}
        self.partial.mkdir(parents=True)
        self._write_json("job.json", self.settings)
        fps, file = self.video_fps, self.partial / "strip.mp4"
        self._video = viz.Video(file, fps=fps) if fps else None

    def append(self, index: int, result: FactorizedFrame) -> None:
        """Writes a frame's files, then its row."""
        self._write_flow(result)
        if self.masks:
            code = np.where(moves(result, self.moving_px), 255, 0)
            mask = np.where(result.valid, code, 127).astype(np.uint8)
            write_picture(self._file(f"moving/{result.frame.name}.png"), mask)
        self._write_pose(index, result)
        if self._video is not None:
            scales: Any = {"flow_scale_px": self.scale_px, "depth_range_m": self.depth_range_m}
            self._video.append(video_frame(result, **scales))
        self.rows.append(score(index, result, moving_px=self.moving_px))
        append_rows(self.partial / "frames.csv", self.rows[-1:])  # a killed job keeps its rows

    def close(self) -> None:
        """Completes the video; removes the folder if there is no frame."""
        if self._video is not None:
            self._video.close()
        self._video = None
        if not self.rows:
            shutil.rmtree(self.partial, ignore_errors=True)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Writes the summary and gives the folder its final name."""
        self._write_json("summary.json", summary)
        self.partial.replace(self.path)

    def medians(self) -> dict[str, float | None]:
        """Returns the median over the frames of each column of measurements."""
        medians: dict[str, float | None] = {}
        for name in list(self.rows[0])[4:]:
            values = [float(row[name]) for row in self.rows if row[name] != ""]
            medians[name] = float(np.median(values)) if values else None
        return medians

    def _write_flow(self, result: FactorizedFrame) -> None:
        name = result.frame.name
        # Not by the frame's index: the first has no flow, and a stride may skip all the others.
        has_pictures = self.pictures_every and len(self.rows) % self.pictures_every == 0
        for kind in FLOW_NAMES:
            flow = shown(kind, result)
            if "flo" in self.flow_files:
                write_flo(self._file(f"flow/{kind}/{name}.flo"), flow)
            if "kitti" in self.flow_files:
                write_kitti_flow(self._file(f"flow/{kind}/{name}.png"), flow)
            if has_pictures:
                picture = viz.representation_strip({kind: flow}, flow_scale_px=self.scale_px)
                write_picture(self._file(f"pictures/{kind}/{name}.png"), picture)
        if "npz" in self.flow_files:
            contents: Any = {
                key: getattr(result, key) for key in (*FLOW_NAMES, "valid", "ego_valid")
            }
            contents |= {"K": result.frame.K, "prev_K": result.previous.K}
            contents |= {"prev_from_curr": result.motion.prev_from_curr}
            np.savez(self._file(f"flow/{name}.npz"), **contents)

    def _write_pose(self, index: int, result: FactorizedFrame) -> None:
        """Adds a frame's pose to trajectory.txt: the recorded one, or estimated.

        Estimated motions are chained from the first frame of a clip, from its recorded pose if it
        has one. Frames without a time have their number.
        """
        frame, before, lines = result.frame, result.previous, []
        if before.name not in self._poses:
            start = np.eye(4) if before.world_from_cam is None else before.world_from_cam
            self._poses[before.name] = start
            lines.append(tum_line(_stamp(before, index - 1), start))
        pose = frame.world_from_cam
        if pose is None or result.motion.is_estimated:
            pose = self._poses[before.name] @ result.motion.prev_from_curr
        self._poses[frame.name] = pose
        lines.append(tum_line(_stamp(frame, index), pose))
        with (self.partial / "trajectory.txt").open("a", encoding="utf-8") as file:
            file.writelines(lines)

    def _file(self, name: str) -> Path:
        path = self.partial / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _write_json(self, name: str, content: Mapping[str, Any]) -> None:
        replace_text(self.partial / name, json.dumps(content, indent=2) + "\n")


def score(index: int, result: FactorizedFrame, *, moving_px: float) -> dict[str, Any]:
    """Returns a row of frames.csv: medians over valid pixels, shares in [0, 1]."""
    frame, truth = result.frame, result.frame.raw
    before_s, now_s = result.previous.timestamp_s, frame.timestamp_s
    seconds = math.nan if before_s is None or now_s is None else abs(now_s - before_s) or math.nan
    before, now = result.previous.position, frame.position
    lengths_px = {name: np.hypot(*getattr(result, name))[result.valid] for name in FLOW_NAMES}
    medians_px = {name: _median(lengths) for name, lengths in lengths_px.items()}
    moving = moves(result, moving_px)[result.valid]
    row: dict[str, Any] = {
        "index": index,
        "name": frame.name,
        "timestamp_s": "" if frame.timestamp_s is None else f"{frame.timestamp_s:.6f}",
        "gap": "" if before is None or now is None else abs(now - before) - 1,
        **{f"{name}_median_px": px for name, px in medians_px.items()},
        **{f"{name}_median_px_per_s": px / seconds for name, px in medians_px.items()},
        "valid_share": float(result.valid.mean()),
        "moving_share": float(moving.mean()) if len(moving) else math.nan,
        "epe_px": math.nan,
        "inlier_share": result.motion.inlier_share,
        "recorded_obj_median_px": math.nan,
        "rotation_off_deg": math.nan,
        "translation_off_m": math.nan,
    }
    if truth is not None and frame.raw_since == result.previous.name:
        error_px = np.hypot(*(result.raw - truth))
        known_px = error_px[np.isfinite(error_px)]
        row["epe_px"] = float(known_px.mean()) if len(known_px) else math.nan
    has_poses = not any(f.world_from_cam is None for f in (result.previous, frame))
    if has_poses and result.motion.known and result.motion.is_estimated:
        recorded = factorize_pair(result.previous, frame, result.raw)
        off = np.linalg.inv(recorded.motion.prev_from_curr) @ result.motion.prev_from_curr
        turn_rad = float(np.linalg.norm(cv2.Rodrigues(off[:3, :3])[0]))
        row["recorded_obj_median_px"] = _median(np.hypot(*recorded.obj)[recorded.valid])
        row["rotation_off_deg"] = math.degrees(turn_rad)
        row["translation_off_m"] = float(np.linalg.norm(off[:3, 3]))
    for name, value in row.items():
        if isinstance(value, float):  # six digits; an empty cell if unknown
            row[name] = f"{value:.6g}" if math.isfinite(value) else ""
    return row


def moves(result: FactorizedFrame, moving_px: float) -> NDArray[np.bool_]:
    """Returns the moving pixels `[H, W]`, whose object flow exceeds `moving_px` and the error.

    If most of the picture is static, the median of object flow measures the error of flow and
    poses. If u and v have errors with a standard deviation of s, the median length is 1.18 s, and
    one length in 500 exceeds three times that, 3.5 s.
    """
    lengths_px = np.hypot(*result.obj)
    least_px = np.nanmax([moving_px, _MOVING_SPREAD * _median(lengths_px[result.valid])])
    moving: NDArray[np.bool_] = result.valid & (lengths_px > least_px)
    return moving


def _stamp(frame: Frame, index: int) -> float:
    number = index if frame.position is None else frame.position
    return float(number) if frame.timestamp_s is None else frame.timestamp_s


def tum_line(time_s: float, world_from_cam: Pose) -> str:
    """Returns the line "time tx ty tz qx qy qz qw" of a pose.

    >>> tum_line(0.5, np.eye(4))
    '0.500000 0 0 0 0 0 0 1\\n'
    """
    axis_angle = cv2.Rodrigues(world_from_cam[:3, :3])[0].ravel()
    half_rad = float(np.linalg.norm(axis_angle)) / 2
    axis_sin = axis_angle / 2 * np.sinc(half_rad / np.pi)  # sin(a) / a, 1 where there is no turn
    numbers = [*world_from_cam[:3, 3], *axis_sin, math.cos(half_rad)]
    return f"{time_s:.6f} {' '.join(f'{number:.9g}' for number in numbers)}\n"


def _median(values: NDArray[np.float32]) -> float:
    return float(np.median(values)) if len(values) else math.nan


def shown(kind: str, result: FactorizedFrame) -> FlowMap:
    """Returns a flow with nan where it is unknown, which is drawn in grey."""
    if kind == "raw":
        return result.raw
    known = result.ego_valid if kind == "ego" else result.valid
    return np.where(known, getattr(result, kind), np.float32(np.nan))


def video_frame(result: FactorizedFrame, **scales: Any) -> viz.Image:
    """Returns RGB and depth above raw, ego and obj; scales are `representation_strip`'s."""
    frame = result.frame
    height, width = frame.size
    shrink = min(1.0, _TILE_PX / max(height, width))
    size = round(height * shrink), round(width * shrink)
    # Maps are sampled (at pixel centres, as in resizing) before they are coloured, which halves the
    # time.
    rows, columns = (
        ((np.arange(n) + 0.5) * full / n).astype(int) for n, full in zip(size, frame.size)
    )
    places: Any = (..., rows[:, None], columns)
    above: dict[str, Any] = {"depth": frame.depth[None][places]}
    if frame.rgb is not None:
        small = cv2.resize(frame.rgb, size[::-1], interpolation=cv2.INTER_AREA)
        above["rgb"] = np.moveaxis(small, -1, 0)
    below = {kind: shown(kind, result)[places] for kind in FLOW_NAMES}
    return viz.contact_sheet([viz.representation_strip(m, **scales) for m in (above, below)])
