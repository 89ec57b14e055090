"""Videos: a webcam or a file, and the pictures of a recording with depth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import count, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.calibration import camera_matrix
from flowrep.sequences.files import regular
from flowrep.sequences.recording import Frame, SequenceError

VIDEOS = (".mp4", ".mov", ".avi", ".mkv")


class StillVideo:
    """Frames of a camera that does not move, so that all flow is object flow.

    The flow of a moving camera can't be factorised without depth, which neither a webcam nor a
    video file has. The user must confirm that the camera is `still`.

    Args:
        source: a camera's number (`0`), or a video file that OpenCV reads.
    """

    has_flow, has_poses = False, True
    notes: tuple[str, ...] = ()

    def __init__(self, source: str | Path | int, *, still: bool = False) -> None:
        self.source = regular(Path(str(source)), math.inf)
        if not still:
            cause = "a video has no depth, without which flow of a moving camera can't be split; "
            remedy = "if it stands still say format.still=true, else bring depth too: format=frames"
            raise SequenceError(source, cause + remedy)
        self._place: int | str = int(str(source)) if str(source).isdecimal() else str(source)

    def __iter__(self) -> Iterator[Frame]:
        for number, rgb in enumerate(pictures(self._place)):
            height, width = rgb.shape[:2]
            # A still camera has no ego flow, whatever depth and K are.
            K = camera_matrix([1.0], (height, width), first_pixel_centre=0.5)
            depth = np.full((height, width), np.inf, dtype=np.float32)
            name = f"{number:06d}"
            yield Frame(name, self.source, np.eye(4), K, depth, rgb, position=number)


def pictures(source: int | str) -> Iterator[NDArray[np.uint8]]:
    """Yields the pictures of a camera or of a file."""
    capture: Any = cv2.VideoCapture(source)
    try:
        for number in count():
            picture = capture.read()[1]
            if picture is None:
                if number == 0:
                    says = "is no camera's number and no video file that OpenCV reads"
                    raise SequenceError(source, says)
                return
            yield np.ascontiguousarray(picture[..., ::-1])
    finally:
        capture.release()


class VideoPictures:
    """The pictures of a video file by their numbers."""

    def __init__(self, path: Path) -> None:
        self.path = regular(path, math.inf)
        capture: Any = cv2.VideoCapture(str(self.path))
        self.count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))  # as the file says, 0 if it doesn't
        capture.release()
        self._next, self._pictures = 0, iter(list[NDArray[np.uint8]]())

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        """Returns a picture; to go back, it reads the file again from the start."""
        # Not OpenCV's seeking, which misses the picture in some codecs.
        if self._next == 0 or index < self._next:
            self._next, self._pictures = 0, pictures(str(self.path))
        picture = next(islice(self._pictures, index - self._next, None), None)
        if picture is None:
            raise SequenceError(self.path, f"has no picture {index}")
        self._next = index + 1
        return picture
