"""A video in chunks, of pictures of two sizes, continued after an interruption."""

import numpy as np
import pytest

pytest.importorskip("imageio_ffmpeg", reason="videos need ffmpeg")

import imageio.v3 as imageio

from flowrep.sequences.output import VideoChunks


def test_a_continued_video_keeps_the_size_of_its_first_frame(tmp_path):
    wide, high = np.zeros((20, 32, 3), np.uint8), np.zeros((26, 30, 3), np.uint8)
    first = VideoChunks(tmp_path / "chunks", fps=5)
    first.append(wide)
    first.close()
    second = VideoChunks(tmp_path / "chunks", fps=5, continue_after=1)
    assert second.frames == 1
    second.append(high)
    second.join(tmp_path / "strip.mp4")
    frames = imageio.imread(tmp_path / "strip.mp4", plugin="FFMPEG")
    assert frames.shape == (2, 20, 32, 3)
    assert frames[1, :, 31].min() > 240  # filled up in white
