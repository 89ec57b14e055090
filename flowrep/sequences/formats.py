"""The formats by name, with the reader of each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from flowrep.sequences.frame import Frame, Recording
from flowrep.sequences.frames import Frames
from flowrep.sequences.kitti import Kitti
from flowrep.sequences.sevenscenes import SevenScenes
from flowrep.sequences.sintel import Sintel
from flowrep.sequences.tartanair import TartanAir
from flowrep.sequences.tum import Tum
from flowrep.sequences.video import StillVideo
from flowrep.sequences.vkitti2 import VKitti2
from flowrep.sequences.zed import Zed
from flowrep.sequences.zed_live import ZedLive


class Stream(Protocol):
    """Frames as they come, from a camera or from a `Recording`, which can also be indexed."""

    @property
    def has_flow(self) -> bool:
        """Whether frames may bring flow of their own."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user, a sentence each."""

    def __iter__(self) -> Iterator[Frame]:
        """Yields the frames in order."""


RECORDINGS: dict[str, type[Recording]] = {
    "frames": Frames,
    "kitti": Kitti,
    "sevenscenes": SevenScenes,
    "sintel": Sintel,
    "tartanair": TartanAir,
    "tum": Tum,
    "vkitti2": VKitti2,
    "zed": Zed,
}
STREAMS = {"video": StillVideo, "zed_live": ZedLive}
