"""Videos as mp4 files, frame by frame or whole."""

from __future__ import annotations

import errno
import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import closing, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from flowrep.files import replace_file
from flowrep.viz.maps import Image

# Constant quality, nearly lossless. `veryfast` takes half the time of x264's default, at the same
# error and size.
_CODEC = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "10", "-preset", "veryfast")


class Video:
    """An mp4 (H.264) that browsers play, written frame by frame.

    Odd sizes, which the codec does not support, are padded with a white row or column. Frames of
    other sizes than the first are cut or padded.

    It starts FFmpeg itself, because imageio's writer ignores FFmpeg's exit status, and so a full
    disk.

    Raises:
        OSError: FFmpeg can't write the file; the message names it.
    """

    def __init__(self, path: str | Path, *, fps: float) -> None:
        self.path, self.fps = Path(path), fps
        self._url = f"file:{self.path.absolute()}"  # FFmpeg would take `out:1` for a protocol
        self._size = 0, 0
        self._ffmpeg: Any = None  # the process, once it has started, and the file of its messages
        self._messages: Any = None

    def append(self, image: Image) -> None:
        """Adds a frame `[H, W, 3]` of uint8."""
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[-1] != 3:
            raise ValueError(f"a frame is [H, W, 3] uint8, got {[*image.shape]} {image.dtype}")
        if self._ffmpeg is None:
            self._start((image.shape[0] + 1) // 2 * 2, (image.shape[1] + 1) // 2 * 2)
        height, width = self._size
        image = image[:height, :width]
        fill = ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0))
        frame = np.pad(image, fill, constant_values=255)
        try:
            self._ffmpeg.stdin.write(frame.tobytes())
        except BrokenPipeError:
            self.close()  # raises FFmpeg's last message

    def close(self) -> None:
        """Completes the file; without frames there is none."""
        if self._ffmpeg is None:
            return
        status, said = self._end()
        if status or not self.path.is_file():
            raise OSError(errno.EIO, said or f"FFmpeg ended with {status}", str(self.path))

    def _start(self, height: int, width: int) -> None:
        from imageio_ffmpeg import get_ffmpeg_exe

        self._size = height, width
        rate = str(Fraction(self.fps).limit_denominator())
        raw = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", rate)
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115 - closed with FFmpeg
        self._ffmpeg = subprocess.Popen(
            [get_ffmpeg_exe(), "-y", "-v", "error", *raw, "-i", "-", *_CODEC, self._url],
            stdin=subprocess.PIPE,
            stderr=self._messages,
            start_new_session=True,  # so that Ctrl-C doesn't end it before this process can
        )

    def _end(self) -> tuple[int, str]:
        """Waits for FFmpeg and returns its exit status and its last message."""
        with suppress(BrokenPipeError):
            self._ffmpeg.stdin.close()
        status = self._ffmpeg.wait()
        with self._messages as file:
            file.seek(0)
            said = file.read().decode(errors="replace").strip().rpartition("\n")[2]
        self._ffmpeg = None
        return status, said.rpartition("] ")[2]  # without the part of FFmpeg that says it


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
