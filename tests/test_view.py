"""`python -m flowrep.view` from start to pictures."""

import csv
import subprocess
import sys
from dataclasses import replace

import imageio.v3 as imageio
import pytest
import torch

pytest.importorskip("pybullet", reason="the command needs the simulator")

from flowrep.baselines import drives, never_turn
from flowrep.config import UsageError
from flowrep.config.schema import ViewConfig, validated
from flowrep.envs import StreetEnv
from flowrep.scenes import load_scene
from flowrep.scenes.scene import CameraConfig
from flowrep.view import check, drive_on, film, moments, moving_pixels
from tests.config.composing import plain

TINY = CameraConfig(6, 8, 90.0, 1.5, 0.0, -5.0, 0.2, 300.0)
SMALL = ["scene.camera.height_px=24", "scene.camera.width_px=32", "episodes=2", "sheet_rows=2"]


def view(*arguments):
    command = [sys.executable, "-m", "flowrep.view", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.slow
def test_a_scene_is_driven_drawn_filmed_and_counted(tmp_path):
    out = tmp_path / "seen"
    done = view("scene=three_way_junction", "policy=never_turn", *SMALL, f"hydra.run.dir={out}")
    assert done.returncode == 0, done.stderr
    assert {path.name for path in out.iterdir()} == {
        "sheet.png", "episode.mp4", "plan.png", "episodes.csv", "categories.csv"
    }  # fmt: skip
    with (out / "episodes.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["outcome"], first["hit"]) == ("out_of_bounds", "")
    assert first["episode_seed"] != second["episode_seed"]
    with (out / "categories.csv").open(newline="") as file:
        seen = {row["category"]: int(row["pixels"]) for row in csv.DictReader(file)}
    assert len(seen) == 11
    assert min(seen["road"], seen["sky"], seen["pedestrian"], seen["tree"]) > 0
    frames = imageio.imread(out / "episode.mp4", plugin="FFMPEG")
    assert len(frames) == int(first["steps"]) + 1
    # Six tiles of 32 x 24, enlarged by a whole factor to some 240 px each.
    assert frames.shape[2] > 6 * 200


def config_of(*overrides):
    return validated(ViewConfig, plain("view", *overrides))


def test_a_path_that_the_scene_lacks_is_named():
    with pytest.raises(UsageError, match="main"):
        check(config_of("path=up"))


@pytest.mark.slow
def test_the_episodes_that_are_shown_are_those_of_the_seed():
    def shown(seed):
        config = config_of("policy=never_turn", f"seed={seed}")
        street = {"scene": replace(load_scene("straight_road"), camera=TINY)}
        episodes = [film(config, street)[1], *drive_on(config, street, 2)]
        return [episode.episode_seed for episode in episodes]

    env = StreetEnv("straight_road", sensors=())
    expected = [drive.episode_seed for drive in drives(env, never_turn, 3, seed=7)]
    env.close()
    assert shown(7) == expected
    assert shown(8) != expected


@pytest.mark.slow
def test_without_a_screen_the_command_ends_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    done = view("interactive=true", f"hydra.run.dir={tmp_path}")
    assert done.returncode == 2
    assert done.stderr.startswith("error: interactive=true needs a screen")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("motion", "rows", "expected"),
    [
        ([0, 0, 3, 1, 0, 0, 0, 2], 2, [2, 7]),
        ([5, 1, 1], 1, [0]),
        ([1, 2], 6, [0, 1]),  # an episode of fewer frames than rows: each of them once
    ],
)
def test_a_sheet_shows_the_liveliest_moment_of_each_stretch(motion, rows, expected):
    assert moments(motion, rows) == expected


def test_what_is_right_before_the_lens_does_not_make_a_moment_lively():
    obj = torch.zeros(2, 1, 4)
    obj[1, 0, 1:] = 0.5  # v alone
    depth = torch.tensor([[[9.0, 3.0, 9.0, torch.inf]]])
    assert moving_pixels({"obj": obj, "depth": depth}) == 2
