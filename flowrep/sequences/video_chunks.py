"""An mp4 that can be continued after any interruption: written in chunks, joined at the end."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from flowrep.viz import Image
from flowrep.viz.maps import sampled_for_codec

CHUNK_FRAMES = 100


class VideoChunks:
    """Writes a video in chunks of some frames each; only complete chunks get their final name.

    Args:
        folder: the folder of the chunks, `<first frame>-<frames>.mp4`.
        fps: frames per second.
        continue_after: the most frames of an interrupted video to keep; `frames` is the number
            that was kept.
    """

    def __init__(self, folder: Path, *, fps: float, continue_after: int = 0) -> None:
        self.folder, self.fps = folder, fps
        self.frames = _keep_whole(folder, continue_after)
        self._size = _size_of(next(folder.glob("00000000-*.mp4"))) if self.frames else None
        self._writer: Any = None
        self._in_chunk = 0

    def append(self, image: Image) -> None:
        """Adds a frame; if its size differs from the first one's, it is cut or padded in white."""
        image = sampled_for_codec(image)
        if self._writer is None:
            self._open(image)
        assert self._size is not None
        height, width = self._size
        image = image[:height, :width]
        fill = ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0))
        self._writer.append_data(np.pad(image, fill, constant_values=255))
        self._in_chunk += 1
        if self._in_chunk == CHUNK_FRAMES:
            self.close()

    def close(self) -> None:
        """Completes the current chunk, so that its frames are kept."""
        if self._writer is None:
            return
        self._writer.close()
        name = f"{self.frames:08d}-{self._in_chunk:04d}.mp4"
        self._part.replace(self.folder / name)
        self.frames += self._in_chunk
        self._writer, self._in_chunk = None, 0

    def join(self, path: Path) -> None:
        """Writes all chunks into one video and removes them."""
        import imageio_ffmpeg

        self.close()
        chunks = sorted(self.folder.glob("*-*.mp4"))
        if not chunks:
            return
        listing = self.folder / "chunks.txt"
        listing.write_text("".join(f"file '{chunk.name}'\n" for chunk in chunks), encoding="utf-8")
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "concat"]
        command += ["-i", str(listing), "-c", "copy", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(f"{path}: ffmpeg could not join the video: {done.stderr.strip()[-200:]}")
        for file in (*chunks, listing):
            file.unlink()
        self.folder.rmdir()

    @property
    def _part(self) -> Path:
        return self.folder / f"{self.frames:08d}.part.mp4"

    def _open(self, image: Image) -> None:
        import imageio.v2 as imageio

        self.folder.mkdir(parents=True, exist_ok=True)
        if self._size is None:  # even, as the codec requires
            self._size = (image.shape[0] + 1) // 2 * 2, (image.shape[1] + 1) // 2 * 2
        self._writer = imageio.get_writer(
            self._part,
            fps=self.fps,
            codec="libx264",
            quality=8,
            pixelformat="yuv420p",
            macro_block_size=1,
            # Frames in display order, so that chunks join without a gap in time.
            output_params=["-bf", "0"],
        )


def _keep_whole(folder: Path, at_most: int) -> int:
    """Returns the number of frames in complete chunks, after removing those beyond `at_most`."""
    frames = 0
    for unfinished in folder.glob("*.part.mp4"):
        unfinished.unlink()
    for chunk in sorted(folder.glob("*-*.mp4")):
        first, count = (int(part) for part in chunk.stem.split("-"))
        if first == frames and first + count <= at_most:
            frames += count
        else:
            chunk.unlink()
    return frames


def _size_of(chunk: Path) -> tuple[int, int]:
    """Returns the height and width of a video."""
    import imageio.v3 as imageio

    width, height = imageio.immeta(chunk, plugin="FFMPEG")["size"]
    return height, width
