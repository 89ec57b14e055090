"""Videos as mp4 files, frame by frame or whole."""

from __future__ import annotations

import errno
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from flowrep.files import replace_file
from flowrep.viz.maps import Image

# Constant quality, nearly lossless. `veryfast` takes half the time of x264's default, at the same
# error and size.
_QUALITY = ["-crf", "10", "-preset", "veryfast"]


class Video:
    """An mp4 (H.264) that browsers play, written frame by frame.

    Odd sizes, which the codec does not support, are padded with a white row or column. Frames of
    other sizes than the first are cut or padded.

    Raises:
        OSError: FFmpeg can't write the file; the message names it.
    """

    def __init__(self, path: str | Path, *, fps: float) -> None:
        self.path, self.fps = Path(path), fps
        self._size, self._frames = (0, 0), 0
        self._writer: Any = None  # once there is a frame

    def append(self, image: Image) -> None:
        """Adds a frame `[H, W, 3]` of uint8."""
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[-1] != 3:
            raise ValueError(f"a frame is [H, W, 3] uint8, got {[*image.shape]} {image.dtype}")
        if self._writer is None:
            self._start((image.shape[0] + 1) // 2 * 2, (image.shape[1] + 1) // 2 * 2)
        height, width = self._size
        image = image[:height, :width]
        fill = ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0))
        try:
            self._writer.send(np.pad(image, fill, constant_values=255).tobytes())
        except OSError:  # FFmpeg has ended, after a line on stderr that says why
            raise self._unwritten() from None
        self._frames += 1

    def close(self) -> None:
        """Completes the file; without frames there is none."""
        from imageio_ffmpeg import count_frames_and_secs

        if self._writer is None:
            return
        self._writer.close()
        self._writer = None
        # The writer ignores FFmpeg's exit status, and so a disk that is full at the end.
        try:
            written, _ = count_frames_and_secs(str(self.path.absolute()))
        except RuntimeError:
            written = 0
        if written < self._frames:
            raise self._unwritten()

    def _start(self, height: int, width: int) -> None:
        from imageio_ffmpeg import write_frames

        self._size = height, width
        self._writer = write_frames(
            f"file:{self.path.absolute()}",  # FFmpeg would take `out:1` for a protocol
            (width, height), fps=self.fps, codec="libx264", quality=None, macro_block_size=1,
            ffmpeg_log_level="error", output_params=_QUALITY,
        )  # fmt: skip
        self._writer.send(None)

    def _unwritten(self) -> OSError:
        return OSError(errno.EIO, "FFmpeg can't write it; is the disk full?", str(self.path))


def write_video(path: str | Path, frames: Iterable[Image], *, fps: float) -> None:
    """Writes frames `[H, W, 3]` as an mp4, see `Video`; its folder is created if needed.

    The file appears when it is complete, in place of an earlier one.

    Raises:
        OSError: see `Video`; or there are no frames.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with replace_file(Path(path)) as partial, closing(Video(partial, fps=fps)) as video:
        for frame in frames:
            video.append(frame)
