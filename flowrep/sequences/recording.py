"""Recordings and their frames, in flowrep's conventions, read one at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from flowrep.geometry import check_intrinsics

Pose = NDArray[np.float64]  # world_from_cam [4, 4]


class SequenceError(Exception):
    """A recording can't be read; the message is one line that names the file and the cause."""

    def __init__(self, path: object, cause: str) -> None:
        super().__init__(f"{path}: {cause}")


@dataclass(frozen=True)
class Frame:
    """One frame of a recording; what the recording lacks is None.

    Convention: as in CONVENTIONS.md. The camera's axes are OpenCV's, the centre of pixel (0, 0) is
    (0.5, 0.5), depth is z in metres (nan: missing, inf: no surface), all on one pixel grid.

    Attributes:
        name: unique in the recording; names the files written for the frame.
        source: the file that errors about the frame name.
        world_from_cam: `[4, 4]`.
        K: `[3, 3]`, pixels.
        depth: `[H, W]`, metres.
        rgb: `[H, W, 3]`.
        timestamp_s: seconds, in the recording's own clock.
        raw: `[2, H, W]`, the recorded flow p_t - p_t'; nan where unknown.
        raw_since: the name of the frame t' from which `raw` is measured, None if it is missing.
        clip: the number of its clip. There is no flow from one clip to another.
        position: its number in the recording; missing frames count, too.
    """

    name: str
    source: Path
    world_from_cam: Pose | None
    K: NDArray[np.float64]
    depth: NDArray[np.float32]
    rgb: NDArray[np.uint8] | None = None
    timestamp_s: float | None = None
    raw: NDArray[np.float32] | None = None
    raw_since: str | None = None
    clip: int = 0
    position: int | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.depth.shape


class Stream(Protocol):
    """Frames in order, from a camera or a `Recording`, which explains the attributes."""

    has_flow: bool
    has_poses: bool
    notes: tuple[str, ...]

    def __iter__(self) -> Iterator[Frame]: ...


class Recording(ABC):
    """Frames on disk, which are read on demand and not cached.

    A reader's constructor and its frames raise `SequenceError` for invalid files and `OSError` for
    missing ones.

    Attributes:
        has_flow: whether frames have recorded flow, `raw`.
        has_poses: whether frames have `world_from_cam`.
        no_flow: why there is no recorded flow, and what to do.
        notes: sentences for the user.
        conventions: the options about conventions with which it was opened, for the diagnosis.
    """

    count: int
    has_flow: bool = False
    has_poses: bool = True
    no_flow: str = "the format has none: use flow=estimated"
    notes: tuple[str, ...] = ()
    conventions: Mapping[str, str] = MappingProxyType({})

    def __len__(self) -> int:
        return self.count

    @abstractmethod
    def _frame(self, index: int) -> Frame:
        """Returns a frame, unchecked."""

    def __getitem__(self, index: int) -> Frame:
        """Returns a frame, after a check that its maps have one size and K is valid."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        frame = self._frame(index)
        shapes = {"depth": frame.size}
        shapes |= {} if frame.rgb is None else {"colour": frame.rgb.shape[:2]}
        shapes |= {} if frame.raw is None else {"flow": frame.raw.shape[1:]}
        if len({*shapes.values()}) > 1:
            listing = ", ".join(f"{name} {w} x {h}" for name, (h, w) in shapes.items())
            raise SequenceError(frame.source, f"pictures of one frame differ in size: {listing}")
        try:
            check_intrinsics("intrinsics", torch.from_numpy(frame.K))
        except ValueError as error:
            raise SequenceError(frame.source, str(error)) from None
        return frame

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))
