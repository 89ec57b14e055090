"""A webcam or a video file of a camera that stands still: no pose sensor, no depth."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowrep.sequences.recording import Frame, SequenceError


class StillVideo:
    """Frames of a camera that does not move, so that all flow is object flow.

    The flow of a moving camera can't be factorised without depth, which neither a webcam nor a
    video file gives. The user has to declare explicitly that the camera stands still.

    Args:
        source: a camera's number (`0`), or a video file that OpenCV reads.
        still: whether the camera stands still.

    Raises:
        SequenceError: `still` is false, or the source can't be opened.
    """

    has_flow = False
    has_poses = True
    notes: tuple[str, ...] = ()

    def __init__(self, source: str | Path | int, *, still: bool = False) -> None:
        self.source = Path(str(source))
        if not still:
            raise SequenceError(
                source,
                "a video has no depth, without which flow of a moving camera can't be split; if it "
                "stands still say format.still=true, else bring depth too: format=frames",
            )
        self._is_camera = str(source).isdecimal()
        if not self._is_camera and not self.source.is_file():
            raise SequenceError(source, "no such file; give a video file or a camera's number")

    def __iter__(self) -> Iterator[Frame]:
        """Yields frames until the file ends, or endlessly from a camera."""
        name = str(self.source)
        capture: Any = cv2.VideoCapture(int(name) if self._is_camera else name)
        try:
            number = 0
            while (picture := capture.read()[1]) is not None:
                yield self._frame(number, picture)
                number += 1
            if number == 0:
                raise SequenceError(self.source, "OpenCV reads no picture of it as a video")
        finally:
            capture.release()

    def _frame(self, number: int, picture: Any) -> Frame:
        height, width = picture.shape[:2]
        # A camera that stands still has no ego flow with any depth and any K.
        K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=np.float64)
        return Frame(
            name=f"{number:06d}",
            source=self.source,
            world_from_cam=np.eye(4),
            K=K,
            depth=np.full((height, width), np.inf, dtype=np.float32),
            rgb=np.ascontiguousarray(picture[..., ::-1]),
        )
