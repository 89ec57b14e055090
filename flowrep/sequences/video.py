"""A webcam or a video file of a camera that stands still: no pose sensor, no depth."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowrep.sequences.calibration import intrinsics
from flowrep.sequences.recording import Frame, SequenceError


class StillVideo:
    """Frames of a camera that does not move, so that all flow is object flow.

    The flow of a moving camera can't be factorised without depth, which neither a webcam nor a
    video file gives: the user has to declare that it is `still`.

    Args:
        source: a camera's number (`0`), or a video file that OpenCV reads.
    """

    has_flow, has_poses = False, True
    notes: tuple[str, ...] = ()

    def __init__(self, source: str | Path | int, *, still: bool = False) -> None:
        self.source = Path(str(source))
        if not still:
            cause = "a video has no depth, without which flow of a moving camera can't be split; "
            remedy = "if it stands still say format.still=true, else bring depth too: format=frames"
            raise SequenceError(source, cause + remedy)
        self._place: int | str = int(str(source)) if str(source).isdecimal() else str(source)
        if isinstance(self._place, str) and not self.source.is_file():
            raise SequenceError(source, "no such file; give a video file or a camera's number")

    def __iter__(self) -> Iterator[Frame]:
        capture: Any = cv2.VideoCapture(self._place)
        try:
            for number in count():
                picture = capture.read()[1]
                if picture is None:
                    break
                height, width = picture.shape[:2]
                # A camera that stands still has no ego flow with any depth and any K.
                K = intrinsics(width, width, width / 2, height / 2)
                depth = np.full((height, width), np.inf, dtype=np.float32)
                rgb = np.ascontiguousarray(picture[..., ::-1])
                yield Frame(f"{number:06d}", self.source, np.eye(4), K, depth, rgb)
            if number == 0:
                raise SequenceError(self.source, "OpenCV reads no picture of it as a video")
        finally:
            capture.release()
