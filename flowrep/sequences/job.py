"""Factorises a recording from its first frame to its last."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass
from itertools import count, islice
from typing import Any

import numpy as np

from flowrep.progress import StopRequest, Stopwatch, progress_bar
from flowrep.sequences import factorization
from flowrep.sequences.doctor import Diagnosis, Doctor
from flowrep.sequences.output import Output
from flowrep.sequences.recording import Frame, Recording, Stream

DOCTOR_PAIRS, DOCTOR_TRIES = 10, 3


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
        """Returns what the doctor says of pairs spread over the recording, None without poses."""
        if not isinstance(self.stream, Recording) or not self.stream.has_poses:
            return None
        is_recorded = self.flow_source is factorization.recorded_flow
        doctor = Doctor(self.stream.conventions, flow_is_recorded=is_recorded)
        used = self._indices
        places = np.linspace(1, len(used), DOCTOR_PAIRS, endpoint=False).astype(int)
        with self.clock("doctor"):
            for first, end in zip(places, [*places[1:], len(used)]):
                # A pair that hardly moves, or repeats a picture, is passed over for the next one.
                for place in range(first, min(end, first + DOCTOR_TRIES)):
                    both = (self.stream[i] for i in used[place - 1 : place + 1])
                    _, (previous, current) = factorization.pairs(both)
                    if previous is None or factorization.repeats(previous, current):
                        continue
                    if doctor.look(previous, current, self.flow_source(previous, current)):
                        break
        return doctor.diagnosis()

    def run(self) -> int:
        """Factorises all frames; returns 0, or the exit code for the signal that stopped it."""
        is_recording = isinstance(self.stream, Recording)
        total = len(self._indices) if is_recording else None
        bar = progress_bar(what="factorising", total=total, unit="frame")
        with StopRequest() as interrupted, bar:
            indices, pairs = count(self.start, self.stride), factorization.pairs(self._frames())
            for index, (previous, current) in zip(indices, pairs):
                if previous is not None:
                    with self.clock("raw flow"):
                        raw = self.flow_source(previous, current)
                    with self.clock("motion"):
                        motion = self.motion_source(previous, current, raw)
                    with self.clock("factorising"):
                        made = factorization.factorize_pair(previous, current, raw, motion)
                    with self.clock("writing"):
                        self.output.append(index, made)
                bar.update()
                if interrupted:
                    break
            bar.set_description("completing the video")
            self.output.close()
        return interrupted.exit_code if is_recording else 0  # a signal is the end of a camera

    def _frames(self) -> Iterator[Frame]:
        frames: Iterator[Frame] = islice(self.stream, self.start, self.stop, self.stride)
        if isinstance(self.stream, Recording):  # those in between are not read
            frames = map(self.stream.__getitem__, self._indices)
        while True:
            with self.clock("reading"):
                frame = next(frames, None)
            if frame is None:
                return
            yield frame

    def summary(self, diagnosis: Diagnosis | None) -> dict[str, Any]:
        """Returns medians over the frames, the doctor's diagnosis and the times."""
        return {
            "frames": len(self.output.rows),
            "medians": self.output.medians(),
            "doctor": None if diagnosis is None else diagnosis.words,
            "suspects": [] if diagnosis is None else list(diagnosis.suspects),
            "notes": list(self.stream.notes),
            "seconds": {name: round(spent, 3) for name, spent in self.clock.seconds.items()},
        }
