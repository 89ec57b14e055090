"""Factorises a recording from its first frame to its last; can be stopped at any frame."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from tqdm.auto import tqdm

from flowrep.progress import StopRequest, Stopwatch
from flowrep.sequences.doctor import Diagnosis, Doctor
from flowrep.sequences.factorization import (
    FactorizedFrame,
    FlowSource,
    factorize_pair,
)
from flowrep.sequences.output import (
    OutputFolder,
    OutputOptions,
    RerunExport,
    VideoChunks,
    score,
    video_frame,
    write_frame,
)
from flowrep.sequences.recording import Frame, Recording, Stream

DOCTOR_PAIRS = 10
VIDEO_CHUNKS = "video_chunks"


@dataclass(frozen=True)
class JobOptions:
    """The options of a job.

    Attributes:
        start: index of the first frame.
        stop: index after the last frame, None for all.
        stride: every `stride`-th frame is used.
        moving_px: the object flow from which a pixel counts as moving by itself, pixels.
        video_fps: the video's frames per second, None for no video.
        rerun: whether a rerun recording is written.
        output: other outputs.
    """

    start: int = 0
    stop: int | None = None
    stride: int = 1
    moving_px: float = 1.0
    video_fps: float | None = None
    rerun: bool = False
    output: OutputOptions = field(default_factory=OutputOptions)


class Job:
    """The factorisation of one recording.

    Args:
        stream: the source of frames.
        flow_source: the source of raw flow.
        folder: the output folder.
        options: the job's options.
    """

    def __init__(
        self, stream: Stream, flow_source: FlowSource, folder: OutputFolder, options: JobOptions
    ) -> None:
        self.stream, self.flow_source = stream, flow_source
        self.folder, self.options = folder, options
        self.clock, self.doctor = Stopwatch(), Doctor()
        self.video: VideoChunks | None = None
        self.done = 0

    def run(self) -> Diagnosis | None:
        """Returns the doctor's diagnosis, or None if the job was stopped before its end."""
        resumed_after = self._resume()
        total = self._total(resumed_after)
        with StopRequest() as stop, tqdm(total=total, unit="frame", desc="factorising") as bar:
            with closing(self._writers(resumed_after)) as writers:
                for index, made in self._factorized(resumed_after):
                    if made is not None:
                        self._take(index, made, writers, bar)
                    bar.update()
                    if stop and not self._ends_by_hand:
                        return None
                    if stop:
                        break
            if self.video is not None:
                self.video.join(self.folder.partial / "strip.mp4")
        return self.doctor.diagnosis()

    @property
    def _ends_by_hand(self) -> bool:
        """Whether the job ends with Ctrl-C, since a camera has no last frame."""
        return not isinstance(self.stream, Recording)

    def summary(self) -> dict[str, Any]:
        """Returns medians over the frames, the doctor's diagnosis and the times."""
        rows = self.folder.rows()
        columns = [name for name in (rows[0] if rows else {}) if name.endswith(("_px", "_share"))]
        medians = {}
        for name in columns:
            values = [float(row[name]) for row in rows if row[name]]
            medians[name] = statistics.median(values) if values else None
        diagnosis = self.doctor.diagnosis()
        return {
            "frames": len(rows),
            "medians": medians,
            "doctor": diagnosis.words,
            "suspects": list(diagnosis.suspects),
            "notes": list(self.stream.notes),
            "seconds": {name: round(spent, 3) for name, spent in self.clock.seconds.items()},
        }

    def _resume(self) -> int | None:
        """Returns the index of the last frame that is done, None if there is none."""
        kept = len(self.folder.rows())
        if self.options.video_fps is not None:
            folder = self.folder.partial / VIDEO_CHUNKS
            self.video = VideoChunks(folder, fps=self.options.video_fps, continue_after=kept)
            kept = self.video.frames
        self.folder.keep_rows(kept)
        self.done = kept
        return self.folder.last_index()

    def _writers(self, resumed_after: int | None) -> _Writers:
        rerun, folder = None, self.folder.partial
        if self.options.rerun:
            name = "scene" if resumed_after is None else f"scene_{resumed_after + 1:08d}"
            scale_px = dict(self.options.output.scale_px)
            rerun = RerunExport(folder / f"{name}.rrd", str(self.folder.path), scale_px)
        return _Writers(folder, self.options.output, self.video, rerun)

    def _total(self, resumed_after: int | None) -> int | None:
        """Returns the number of frames to read, None for a camera."""
        if isinstance(self.stream, Recording):
            return len(self._indices(resumed_after))
        stop = self.options.stop
        return None if stop is None else len(range(self.options.start, stop, self.options.stride))

    def _indices(self, resumed_after: int | None) -> range:
        """Returns the indices to read, beginning with the previous frame of the next one."""
        assert isinstance(self.stream, Recording)
        first = self.options.start if resumed_after is None else resumed_after
        last = len(self.stream) if self.options.stop is None else self.options.stop
        return range(first, min(last, len(self.stream)), self.options.stride)

    def _frames(self, resumed_after: int | None) -> Iterator[tuple[int, Frame]]:
        """Yields the frames that are used; one starts a clip if a frame skipped before it does."""
        start, stop, stride = self.options.start, self.options.stop, self.options.stride
        if isinstance(self.stream, Recording):
            for index in self._indices(resumed_after):
                frame, skipped = self.stream[index], range(max(0, index - stride + 1), index)
                starts_clip = frame.starts_clip or any(map(self.stream.starts_clip, skipped))
                yield index, replace(frame, starts_clip=starts_clip)
            return
        starts_clip = False
        for index, frame in islice(enumerate(self.stream), stop):
            starts_clip |= frame.starts_clip
            if index >= start and (index - start) % stride == 0:
                yield index, replace(frame, starts_clip=starts_clip)
                starts_clip = False

    def _factorized(
        self, resumed_after: int | None
    ) -> Iterator[tuple[int, FactorizedFrame | None]]:
        previous: Frame | None = None
        frames = self._frames(resumed_after)
        while True:
            with self.clock("reading"):
                index, current = next(frames, (-1, None))
            if current is None:
                return
            made = None
            if previous is not None and not current.starts_clip:
                with self.clock("raw flow"):
                    raw = self.flow_source(previous, current)
                with self.clock("factorising"):
                    made = factorize_pair(previous, current, raw)
            previous = current
            yield index, made

    def _take(self, index: int, made: FactorizedFrame, writers: _Writers, bar: tqdm) -> None:
        with self.clock("doctor"):
            self._ask_doctor(made, bar)
        with self.clock("scoring"):
            row = score(index, made, moving_px=self.options.moving_px)
        with self.clock("writing"):
            writers.append(index, made)
            self.folder.log(row)
        self.done += 1

    def _ask_doctor(self, made: FactorizedFrame, bar: tqdm) -> None:
        """Shows the doctor the first moving pairs, and prints a warning at once."""
        if self.doctor.pairs >= DOCTOR_PAIRS:
            return
        before = self.doctor.pairs
        self.doctor.look(
            torch.from_numpy(made.raw),
            torch.from_numpy(made.frame.depth)[None],
            torch.from_numpy(made.frame.K),
            torch.from_numpy(made.previous.world_from_cam),
            torch.from_numpy(made.frame.world_from_cam),
        )
        if before < self.doctor.pairs == DOCTOR_PAIRS and self.doctor.diagnosis().suspects:
            bar.write(f"warning: {self.doctor.diagnosis().words}")


class _Writers:
    """Everything that is written frame by frame."""

    def __init__(
        self,
        folder: Path,
        options: OutputOptions,
        video: VideoChunks | None,
        rerun: RerunExport | None,
    ) -> None:
        self.folder, self.options, self.video, self.rerun = folder, options, video, rerun

    def append(self, index: int, made: FactorizedFrame) -> None:
        """Writes one frame to all outputs."""
        write_frame(self.folder, index, made, self.options)
        if self.video is not None:
            self.video.append(video_frame(made, self.options))
        if self.rerun is not None:
            self.rerun.append(index, made)

    def close(self) -> None:
        """Closes all outputs, so that what was written is readable."""
        if self.video is not None:
            self.video.close()
        if self.rerun is not None:
            self.rerun.close()


def as_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings that a continued job must share: all but `resume`."""
    return {key: value for key, value in config.items() if key != "resume"}
