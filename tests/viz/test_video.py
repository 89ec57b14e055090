"""Videos: whole, or not there."""

import resource
from contextlib import contextmanager

import numpy as np
import pytest

from flowrep import viz

imageio = pytest.importorskip("imageio.v3")


def noise(count, size=(64, 96)):
    """Frames that don't compress."""
    draw = np.random.default_rng(0)
    return (draw.integers(0, 256, (*size, 3), dtype=np.uint8) for _ in range(count))


@contextmanager
def full_after(size_bytes):
    """Lets no file grow beyond a size, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_video_of_odd_size_can_be_played_and_keeps_the_size_of_its_first_frame(tmp_path):
    frames = [np.full((33, 51, 3), grey, np.uint8) for grey in (20, 120, 220)]
    frames.append(np.zeros((40, 30, 3), np.uint8))
    path = tmp_path / "new" / "episode.mp4"
    viz.write_video(path, frames, fps=12)
    played = imageio.imread(path)
    assert played.shape == (4, 34, 52, 3)
    assert np.abs(played[:3, 16, 25, 0].astype(int) - [20, 120, 220]).max() <= 6
    assert played[3, :, 40].min() > 240  # filled up in white
    assert [file.name for file in path.parent.iterdir()] == ["episode.mp4"]


@pytest.mark.parametrize("name", ["out:1", "file:x", "-dash", "50 %03d"])
def test_a_folder_may_have_any_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    viz.write_video(f"{name}/film.mp4", noise(2), fps=4)
    assert [str(path) for path in tmp_path.rglob("*.mp4")] == [str(tmp_path / name / "film.mp4")]


@pytest.mark.parametrize("frames", [3, 300])  # full at the end, or while frames are written
def test_a_full_disk_ends_in_one_line_and_leaves_the_old_film(tmp_path, frames):
    path = tmp_path / "episode.mp4"
    path.write_bytes(b"old")
    with full_after(5_000), pytest.raises(OSError, match=r"^.*episode\.mp4.*$"):
        viz.write_video(path, noise(frames), fps=12)
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["episode.mp4"]


def interrupted():
    yield from noise(2)
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("frames", "error", "said"),
    [
        (interrupted(), KeyboardInterrupt, ""),
        ([], OSError, r"film\.mp4"),
        ([np.full((32, 32, 3), 0.5)], ValueError, r"\[H, W, 3\] uint8"),
        ([np.zeros((32, 32, 4), np.uint8)], ValueError, r"\[H, W, 3\] uint8"),
    ],
    ids=["interrupted", "no frames", "float", "alpha"],
)
def test_a_film_that_is_not_written_to_its_end_leaves_no_file(tmp_path, frames, error, said):
    with pytest.raises(error, match=said):
        viz.write_video(tmp_path / "film.mp4", frames, fps=12)
    assert not [*tmp_path.iterdir()]
