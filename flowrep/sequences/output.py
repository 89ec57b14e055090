"""What a factorisation writes: the table, flow files, pictures, the video, a rerun recording."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.factorization import FactorizedFrame
from flowrep.sequences.files import Flow, write_flo, write_kitti_flow
from flowrep.sequences.recording import SequenceError
from flowrep.tables import append_rows, is_whole, read_rows, write_rows
from flowrep.viz import Image, flow_note, flow_to_rgb, representation_strip, strip
from flowrep.viz import flow_to_rgb as colours_of
from flowrep.viz.maps import sampled_for_codec

COLUMNS = (
    "index",
    "name",
    "timestamp_s",
    "raw_median_px",
    "ego_median_px",
    "obj_median_px",
    "valid_share",
    "moving_share",
    "epe_px",
)


def score(index: int, factorized: FactorizedFrame, *, moving_px: float) -> dict[str, Any]:
    """Returns a row of frames.csv: medians over valid pixels, shares in [0, 1].

    Args:
        index: the frame's index in the recording.
        factorized: its flow.
        moving_px: the object flow from which a pixel counts as moving by itself, pixels.
    """
    valid, frame = factorized.valid, factorized.frame
    obj = squared_lengths(factorized.obj, valid)
    row: dict[str, Any] = {
        "index": index,
        "name": frame.name,
        "timestamp_s": "" if frame.timestamp_s is None else f"{frame.timestamp_s:.6f}",
        "raw_median_px": _median_px(squared_lengths(factorized.raw, valid)),
        "ego_median_px": _median_px(squared_lengths(factorized.ego, valid)),
        "obj_median_px": _median_px(obj),
        "valid_share": float(valid.mean()),
        "moving_share": float((obj > moving_px**2).mean()) if len(obj) else math.nan,
        "epe_px": _error_px(factorized),
    }
    return {key: _text(value) for key, value in row.items()}


def _error_px(factorized: FactorizedFrame) -> float:
    """Returns the error against the recording's own flow, nan if it has none for this pair."""
    truth, since = factorized.frame.raw, factorized.frame.raw_since
    if truth is None or since != factorized.previous.name:
        return math.nan
    return end_point_error(factorized.raw, truth)


def squared_lengths(flow: Flow, where: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Returns the squared lengths of the vectors at chosen pixels, `[N]`, square pixels."""
    u, v = flow
    return (u * u + v * v)[where]


def end_point_error(flow: Flow, truth: Flow) -> float:
    """Returns the mean distance in pixels from the truth where both are known; nan if nowhere."""
    error = np.sqrt(np.square(flow - truth).sum(0))
    known = error[np.isfinite(error)]
    return float(known.mean()) if len(known) else math.nan


def _median_px(squares: NDArray[np.float32]) -> float:
    """Returns the median length, for an even count the lower of the two in the middle."""
    if not len(squares):
        return math.nan
    # Non-negative floats sort like their bits. Counting the upper halves of the bits leaves few to
    # sort, in a third of the time of a partition of all of them.
    middle = (len(squares) - 1) // 2
    upper = squares.view(np.uint32) >> 16
    up_to = np.bincount(upper).cumsum()
    of_middle = int(np.searchsorted(up_to, middle, side="right"))
    candidates = squares[upper == of_middle]
    place = middle - (int(up_to[of_middle - 1]) if of_middle else 0)
    candidates.partition(place)
    return math.sqrt(candidates[place])


def _text(value: Any) -> Any:
    """Returns a table cell: empty for an unknown value, six digits for a number."""
    if not isinstance(value, float):
        return value
    return f"{value:.6g}" if math.isfinite(value) else ""


FLOW_FORMATS = ("flo", "kitti", "npz")
FLOW_NAMES = ("raw", "ego", "obj")


@dataclass(frozen=True)
class OutputOptions:
    """The outputs to write.

    Attributes:
        flow_files: formats of flow files, from `FLOW_FORMATS`.
        pictures_every: the number of frames from one set of flow pictures to the next; 0 for none.
        scale_px: the flow of full colour by name, pixels.
        depth_range_m: the depth at which the video's colours end, metres.
    """

    flow_files: Sequence[str] = ("flo",)
    pictures_every: int = 10
    scale_px: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(FLOW_NAMES, 20.0))
    depth_range_m: float = 10.0


def write_frame(
    folder: Path, index: int, factorized: FactorizedFrame, options: OutputOptions
) -> None:
    """Writes the files of one frame.

    ```
    flow/<raw, ego, obj>/<name>.flo      and / or .png, KITTI's
    flow/<name>.npz                      raw, ego, obj, valid, ego_valid, K, prev_from_curr
    pictures/<raw, ego, obj>/<name>.png  colours, with the scale and the wheel
    ```
    """
    name = factorized.frame.name
    for kind in FLOW_NAMES:
        flow, valid = getattr(factorized, kind), known(kind, factorized)
        if "flo" in options.flow_files:
            write_flo(_place(folder, f"flow/{kind}", f"{name}.flo"), flow, valid)
        if "kitti" in options.flow_files:
            write_kitti_flow(_place(folder, f"flow/{kind}", f"{name}.png"), flow, valid)
        if options.pictures_every and index % options.pictures_every == 0:
            picture = flow_picture(kind, factorized, options.scale_px[kind])
            write_picture(_place(folder, f"pictures/{kind}", f"{name}.png"), picture)
    if "npz" in options.flow_files:
        contents: Any = arrays(factorized)
        np.savez(_place(folder, "flow", f"{name}.npz"), **contents)


def known(kind: str, factorized: FactorizedFrame) -> NDArray[np.bool_]:
    """Returns where a flow is known: obj needs raw and ego."""
    if kind == "raw":
        return np.isfinite(factorized.raw[0]) & np.isfinite(factorized.raw[1])
    return factorized.ego_valid if kind == "ego" else factorized.valid


def arrays(factorized: FactorizedFrame) -> dict[str, NDArray[Any]]:
    """Returns the content of a .npz file."""
    previous, current = factorized.previous, factorized.frame
    return {
        "raw": factorized.raw,
        "ego": factorized.ego,
        "obj": factorized.obj,
        "valid": factorized.valid,
        "ego_valid": factorized.ego_valid,
        "K": current.K,
        "prev_from_curr": np.linalg.inv(previous.world_from_cam) @ current.world_from_cam,
    }


def flow_picture(kind: str, factorized: FactorizedFrame, scale_px: float) -> Image:
    """Returns a flow's colours under a label with the scale and the wheel; unknown is grey."""
    label = f"{kind} flow"
    colours = colours_of(shown(kind, factorized), scale_px)
    return strip({label: colours}, wheel_for=[label], notes={label: flow_note(scale_px)})


def shown(kind: str, factorized: FactorizedFrame) -> NDArray[np.float32]:
    """Returns a flow with nan, which is drawn in grey, where it is unknown."""
    flow = getattr(factorized, kind)
    return np.where(known(kind, factorized), flow, np.float32(np.nan))


def video_frame(factorized: FactorizedFrame, options: OutputOptions) -> Image:
    """Returns RGB, depth, raw, ego and obj side by side."""
    frame = factorized.frame
    maps: dict[str, Any] = {"depth": frame.depth[None]}
    if frame.rgb is not None:
        maps["rgb"] = np.moveaxis(frame.rgb, -1, 0)
    maps |= {kind: shown(kind, factorized) for kind in FLOW_NAMES}
    return representation_strip(
        maps, flow_scale_px=options.scale_px, depth_range_m=options.depth_range_m
    )


def write_picture(path: Path, image: Image) -> None:
    """Writes a picture as a PNG with fast rather than strong compression."""
    whole, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not whole:
        raise OSError(f"{path}: OpenCV can't encode it")
    path.write_bytes(data.tobytes())


def _place(folder: Path, kind: str, name: str) -> Path:
    (folder / kind).mkdir(parents=True, exist_ok=True)
    return folder / kind / name


TABLE, JOB, SUMMARY = "frames.csv", "job.json", "summary.json"


class OutputFolder:
    """`<output>.partial` while the job runs, `<output>` once it is complete.

    `job.json` holds the job's settings, `frames.csv` a row for each frame whose files are complete;
    a continued job starts after the last of them.

    Args:
        path: the final folder.
        settings: the job's settings; a job can only be continued with the same ones.
        resume: whether an unfinished job is continued.

    Raises:
        SequenceError: the folder exists already, or holds a job that can't be continued.
    """

    def __init__(self, path: str | Path, settings: Mapping[str, Any], *, resume: bool) -> None:
        self.path = Path(path)
        if self.path.exists():  # also . and /, which have no name
            raise SequenceError(self.path, "exists already; remove it, or give another output")
        self.partial = self.path.with_name(f"{self.path.name}.partial")
        if self.partial.exists() and not resume:
            raise SequenceError(
                self.partial, "is an unfinished job: resume=true continues it, or remove it"
            )
        if resume and not self.partial.exists():
            raise SequenceError(self.partial, "is not there: no unfinished job to continue")
        self._is_new = not resume
        if resume:
            self._check_settings(settings)
        else:
            self.partial.mkdir(parents=True)
            write_json(self.partial / JOB, settings)

    @property
    def table(self) -> Path:
        """The table of frames."""
        return self.partial / TABLE

    def last_index(self) -> int | None:
        """Returns the index of the last frame whose files are complete."""
        try:
            rows = read_rows(self.table)
            return int(rows[-1]["index"]) if rows else None
        except (ValueError, KeyError, TypeError):
            raise SequenceError(self.table, "is not a table of frames: remove the job") from None

    def keep_rows(self, count: int) -> None:
        """Keeps the first `count` rows, and drops an incomplete line at the end."""
        rows = read_rows(self.table)
        if len(rows) > count or not is_whole(self.table):
            write_rows(self.table, rows[:count], COLUMNS)

    def rows(self) -> list[dict[str, str]]:
        """Returns the rows so far."""
        return read_rows(self.table)

    def log(self, row: Mapping[str, Any]) -> None:
        """Appends the row of a frame whose files are complete."""
        append_rows(self.table, [row], COLUMNS)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Writes the summary and gives the folder its final name."""
        write_json(self.partial / SUMMARY, summary)
        self.partial.replace(self.path)

    def discard_if_empty(self) -> None:
        """Removes the folder if it is new and holds no complete frame."""
        if self._is_new and not self.table.exists():
            shutil.rmtree(self.partial)

    def _check_settings(self, settings: Mapping[str, Any]) -> None:
        path = self.partial / JOB
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise SequenceError(path, "can't be read: remove the unfinished job") from None
        now = json.loads(json.dumps(settings))
        for key in sorted({*before, *now}):
            if before.get(key) != now.get(key):
                raise SequenceError(
                    path,
                    f"the job was started with {key}={before.get(key)}, not {now.get(key)}: "
                    "continue it as it was started, or remove it",
                )


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a JSON file atomically."""
    fresh = path.with_name(f"{path.name}.tmp")
    fresh.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    fresh.replace(path)


CHUNK_FRAMES = 100


class VideoChunks:
    """Writes a video in chunks of some frames each; only complete chunks get their final name.

    Args:
        folder: the folder of the chunks, `<first frame>-<frames>.mp4`.
        fps: frames per second.
        continue_after: the most frames of an interrupted video to keep; `frames` is the number
            that was kept.
    """

    def __init__(self, folder: Path, *, fps: float, continue_after: int = 0) -> None:
        self.folder, self.fps = folder, fps
        self.frames = _keep_whole(folder, continue_after)
        self._size = _size_of(next(folder.glob("00000000-*.mp4"))) if self.frames else None
        self._writer: Any = None
        self._in_chunk = 0

    def append(self, image: Image) -> None:
        """Adds a frame; if its size differs from the first one's, it is cut or padded in white."""
        image = sampled_for_codec(image)
        if self._writer is None:
            self._open(image)
        assert self._size is not None
        height, width = self._size
        image = image[:height, :width]
        fill = ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0))
        self._writer.append_data(np.pad(image, fill, constant_values=255))
        self._in_chunk += 1
        if self._in_chunk == CHUNK_FRAMES:
            self.close()

    def close(self) -> None:
        """Completes the current chunk, so that its frames are kept."""
        if self._writer is None:
            return
        self._writer.close()
        name = f"{self.frames:08d}-{self._in_chunk:04d}.mp4"
        self._part.replace(self.folder / name)
        self.frames += self._in_chunk
        self._writer, self._in_chunk = None, 0

    def join(self, path: Path) -> None:
        """Writes all chunks into one video and removes them."""
        import imageio_ffmpeg

        self.close()
        chunks = sorted(self.folder.glob("*-*.mp4"))
        if not chunks:
            return
        listing = self.folder / "chunks.txt"
        listing.write_text("".join(f"file '{chunk.name}'\n" for chunk in chunks), encoding="utf-8")
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "concat"]
        command += ["-i", str(listing), "-c", "copy", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{path}: ffmpeg could not join the video: {done.stderr.strip()[-200:]}")
        for file in (*chunks, listing):
            file.unlink()
        self.folder.rmdir()

    @property
    def _part(self) -> Path:
        return self.folder / f"{self.frames:08d}.part.mp4"

    def _open(self, image: Image) -> None:
        import imageio.v2 as imageio

        self.folder.mkdir(parents=True, exist_ok=True)
        if self._size is None:  # even, as the codec requires
            self._size = (image.shape[0] + 1) // 2 * 2, (image.shape[1] + 1) // 2 * 2
        self._writer = imageio.get_writer(
            self._part,
            fps=self.fps,
            codec="libx264",
            quality=8,
            pixelformat="yuv420p",
            macro_block_size=1,
            # Frames in display order, so that chunks join without a gap in time.
            output_params=["-bf", "0"],
        )


def _keep_whole(folder: Path, at_most: int) -> int:
    """Returns the number of frames in complete chunks, after removing those beyond `at_most`."""
    frames = 0
    for unfinished in folder.glob("*.part.mp4"):
        unfinished.unlink()
    for chunk in sorted(folder.glob("*-*.mp4")):
        first, count = (int(part) for part in chunk.stem.split("-"))
        if first == frames and first + count <= at_most:
            frames += count
        else:
            chunk.unlink()
    return frames


def _size_of(chunk: Path) -> tuple[int, int]:
    """Returns the height and width of a video."""
    import imageio.v3 as imageio

    width, height = imageio.immeta(chunk, plugin="FFMPEG")["size"]
    return height, width


_JPEG_QUALITY = 80


class RerunExport:
    """Writes the camera, picture, depth and flow of each frame.

    Args:
        path: the .rrd file. Several files of one recording open as one.
        recording: its name, the same for all files of it.
        scale_px: the flow of full colour by name, pixels.

    Raises:
        SequenceError: rerun is not installed.
    """

    def __init__(self, path: Path, recording: str, scale_px: dict[str, float]) -> None:
        try:
            import rerun
        except ImportError:
            raise SequenceError(
                "rerun=true", "needs the package rerun-sdk: pip install 'flowrep[rerun]'"
            ) from None
        self._rerun: Any = rerun
        self._stream = rerun.RecordingStream("flowrep", recording_id=recording)
        self._stream.save(str(path))
        self.scale_px = scale_px

    def append(self, index: int, factorized: FactorizedFrame) -> None:
        """Logs one frame."""
        rr, frame = self._rerun, factorized.frame
        self._stream.set_time("frame", sequence=index)
        if frame.timestamp_s is not None:
            self._stream.set_time("time", duration=frame.timestamp_s)
        pose = frame.world_from_cam
        self._log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        height, width = frame.size
        self._log(
            "world/camera/image",
            rr.Pinhole(
                image_from_camera=frame.K,
                resolution=[width, height],
                camera_xyz=rr.ViewCoordinates.RDF,
            ),
        )
        if frame.rgb is not None:
            picture = rr.Image(frame.rgb).compress(jpeg_quality=_JPEG_QUALITY)
            self._log("world/camera/image/rgb", picture)
        depth = np.where(np.isfinite(frame.depth), frame.depth, 0.0).astype(np.float32)
        self._log("world/camera/image/depth", rr.DepthImage(depth, meter=1.0))
        for name, scale_px in self.scale_px.items():
            colours = flow_to_rgb(shown(name, factorized), scale_px)
            self._log(f"flow/{name}", rr.Image(colours).compress(jpeg_quality=_JPEG_QUALITY))

    def close(self) -> None:
        """Writes what is left."""
        self._stream.flush()
        self._stream.disconnect()

    def _log(self, place: str, what: Any) -> None:
        self._stream.log(place, what)
