"""Factorises a recording from its first frame to its last."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass, replace
from itertools import count, islice
from typing import Any

import numpy as np
import torch
from tqdm.auto import tqdm

from flowrep.progress import StopRequest, Stopwatch
from flowrep.sequences.doctor import Diagnosis, Doctor
from flowrep.sequences.factorization import (
    FlowSource,
    MotionSource,
    factorize_pair,
    pairs,
    picture_of,
    recorded_flow,
    repeats,
)
from flowrep.sequences.output import Output
from flowrep.sequences.recording import Frame, Recording, Stream

DOCTOR_PAIRS, DOCTOR_TRIES = 10, 3


@dataclass(frozen=True)
class Selection:
    """The frames that are used: from `start` to before `stop` (None: to the end), every n-th."""

    start: int = 0
    stop: int | None = None
    stride: int = 1

    def __str__(self) -> str:
        """Returns it as on the command line."""
        stop = "" if self.stop is None else f" stop={self.stop}"
        return f"the frames start={self.start}{stop} stride={self.stride}"


class Job:
    """The factorisation of one recording, or of a camera's frames, into a folder."""

    def __init__(
        self,
        stream: Stream,
        flow_source: FlowSource,
        motion_source: MotionSource,
        output: Output,
        selection: Selection | None = None,
    ) -> None:
        self.stream, self.output = stream, output
        self.flow_source, self.motion_source = flow_source, motion_source
        self.selection = selection or Selection()
        self.clock = Stopwatch()

    def examine(self) -> Diagnosis | None:
        """Returns what the doctor says of pairs spread over the recording, None without poses."""
        if not isinstance(self.stream, Recording) or not self.stream.has_poses:
            return None
        doctor = Doctor(self.stream.conventions, flow_is_recorded=self.flow_source is recorded_flow)
        count = self._total() or 0
        starts = np.linspace(1, count, DOCTOR_PAIRS, endpoint=False).astype(int)
        with self.clock("doctor"):
            for first, end in zip(starts, [*starts[1:], count]):
                for place in range(first, min(end, first + DOCTOR_TRIES)):
                    if self._show(doctor, place):
                        break
        return doctor.diagnosis()

    def _show(self, doctor: Doctor, place: int) -> bool:
        """Shows the doctor the pair that ends with a frame; returns whether it moves enough."""
        current = self._frame(place)
        if current.starts_clip:
            return False
        previous = self._frame(place - 1)
        if repeats(previous, current):
            return False
        before = doctor.pairs
        doctor.look(
            torch.from_numpy(self.flow_source(previous, current)),
            torch.from_numpy(current.depth)[None],
            torch.from_numpy(current.K),
            torch.from_numpy(previous.world_from_cam),
            torch.from_numpy(current.world_from_cam),
            picture=picture_of(current),
        )
        return doctor.pairs > before

    def run(self) -> bool:
        """Factorises all frames; returns whether it came to the end.

        Ctrl-C ends it after the current frame. That is the end of a camera, which has no last one.
        """
        with StopRequest() as interrupted, tqdm(total=self._total(), unit="frame") as bar:
            for index, previous, current in self._pairs():
                if previous is not None:
                    with self.clock("raw flow"):
                        raw = self.flow_source(previous, current)
                    with self.clock("motion"):
                        motion = self.motion_source(previous, current, raw)
                    with self.clock("factorising"):
                        made = factorize_pair(previous, current, raw, motion)
                    with self.clock("writing"):
                        self.output.append(index, made)
                bar.update()
                if interrupted:
                    break
            bar.set_description("completing the video")
            self.output.close()
        return not interrupted or not isinstance(self.stream, Recording)

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

    def _total(self) -> int | None:
        """Returns the number of frames to read, None for a camera."""
        start, stop, stride = astuple(self.selection)
        if isinstance(self.stream, Recording):
            stop = len(self.stream) if stop is None else min(stop, len(self.stream))
        return None if stop is None else len(range(start, stop, stride))

    def _frame(self, place: int) -> Frame:
        """Returns a frame that is used, by its place among them, of a recording.

        It starts a clip if a frame skipped before it does.
        """
        assert isinstance(self.stream, Recording)
        start, _, stride = astuple(self.selection)
        index = start + place * stride
        skipped = range(max(0, index - stride + 1), index)
        frame = self.stream[index]
        starts_clip = frame.starts_clip or any(map(self.stream.starts_clip, skipped))
        return replace(frame, starts_clip=starts_clip)

    def _frames(self) -> Iterator[Frame]:
        """Yields the frames that are used."""
        if isinstance(self.stream, Recording):
            yield from map(self._frame, range(self._total() or 0))
            return
        start, stop, stride = astuple(self.selection)
        starts_clip = False
        for index, frame in islice(enumerate(self.stream), stop):
            starts_clip |= frame.starts_clip
            if index >= start and (index - start) % stride == 0:
                yield replace(frame, starts_clip=starts_clip)
                starts_clip = False

    def _pairs(self) -> Iterator[tuple[int, Frame | None, Frame]]:
        """Yields the index of each frame, the frame its flow is measured from, and itself."""
        found = pairs(self._frames())
        for index in count(self.selection.start, self.selection.stride):
            with self.clock("reading"):
                pair = next(found, None)
            if pair is None:
                return
            yield index, *pair
