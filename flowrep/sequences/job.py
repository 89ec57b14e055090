"""Factorises a recording from its first frame to its last."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, replace
from itertools import count, islice, pairwise
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from flowrep.diagnosis import Diagnosis, Examination
from flowrep.files import naming
from flowrep.progress import StopRequest, Stopwatch
from flowrep.sequences import factorization
from flowrep.sequences.output import Output
from flowrep.sequences.recording import Frame, Recording, Stream

# Pairs are examined in consecutive groups, so that poses that lag or lead are noticed.
EXAMINED_RUNS, EXAMINED_PAIRS = 4, 5


@dataclass
class Job:
    """The factorisation of a recording, or of a camera's frames, into a folder.

    The frames `start`, `start + stride`, ... before `stop` are used. For the sources of flow and of
    motion see `factorize_frames`.
    """

    stream: Stream
    flow_source: factorization.FlowSource
    motion_source: factorization.MotionSource
    output: Output
    _: KW_ONLY
    start: int = 0
    stop: int | None = None
    stride: int = 1

    def __post_init__(self) -> None:
        self.clock = Stopwatch()
        self._indices = range(0)  # of the frames that are used, of a recording
        if isinstance(self.stream, Recording):
            self._indices = range(len(self.stream))[self.start : self.stop : self.stride]

    def examine(self) -> Diagnosis | None:
        """Returns the diagnosis of groups of pairs across the recording, None for a stream."""
        if not isinstance(self.stream, Recording):
            return None
        is_recorded = self.flow_source is factorization.recorded_flow
        uses_poses = self.motion_source is factorization.recorded_motion
        examination = Examination(self.stream.conventions, flow_is_recorded=is_recorded)
        used = self._indices
        ends = np.linspace(0, len(used), EXAMINED_RUNS + 1).astype(int).tolist()
        with self.clock("diagnosis"):
            for start, end in pairwise(ends):
                run = used[max(start - 1, 0) : end][: EXAMINED_PAIRS + 1]
                frames = [self.stream[i] for i in run]
                if not uses_poses:
                    frames = [replace(frame, world_from_cam=None) for frame in frames]
                poses = [None, *(frame.world_from_cam for frame in frames), None]
                around = {f.name: (poses[i], poses[i + 2]) for i, f in enumerate(frames)}
                for previous, current in factorization.pairs(frames):
                    # A picture that repeats the previous one has no flow to examine.
                    if previous is not None and not factorization.repeats(previous, current):
                        raw = self.flow_source(previous, current)
                        earlier, later = around[previous.name][0], around[current.name][1]
                        examination.add(previous, current, raw, earlier, later)
            return examination.diagnosis()

    def run(self) -> int:
        """Factorises all frames; returns 0, or the exit code of the signal that stopped it."""
        is_recording = isinstance(self.stream, Recording)
        total = len(self._indices) if is_recording else None
        flow_source = self.clock("raw flow")(self.flow_source)
        motion_source = self.clock("motion")(self.motion_source)
        results = factorization.factorize_frames(self._frames(), flow_source, motion_source)
        with StopRequest() as interrupted, tqdm(total=total, unit="frame") as bar:
            for index, result in zip(count(self.start, self.stride), results):
                if result is not None:
                    with self.clock("writing"), naming(self.output.partial):
                        self.output.append(index, result)
                bar.update()
                if interrupted:
                    break
            bar.set_description("completing the video")
            self.output.close()
        return interrupted.exit_code if is_recording else 0  # a signal is how a camera's job ends

    def _frames(self) -> Iterator[Frame]:
        frames: Iterator[Frame] = islice(self.stream, self.start, self.stop, self.stride)
        if isinstance(self.stream, Recording):  # skipped frames are not read
            frames = map(self.stream.__getitem__, self._indices)
        while True:
            with self.clock("reading"):
                frame = next(frames, None)
            if frame is None:
                return
            yield frame

    def summary(self, diagnosis: Diagnosis | None) -> dict[str, Any]:
        """Returns medians over the frames, the diagnosis and the times."""
        return {
            "frames": len(self.output.rows),
            "medians": self.output.medians(),
            "diagnosis": None if diagnosis is None else str(diagnosis),
            "suspects": [] if diagnosis is None else list(diagnosis.suspects),
            "notes": list(self.stream.notes),
            "seconds": {name: round(spent, 3) for name, spent in self.clock.seconds.items()},
        }
