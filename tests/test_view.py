"""`python -m flowrep.view` from start to pictures."""

import csv
import subprocess
import sys

import imageio.v3 as imageio
import pytest

pytest.importorskip("pybullet", reason="the command needs the simulator")

SMALL = ["scene.camera.height_px=24", "scene.camera.width_px=32", "episodes=2", "sheet_rows=2"]


def view(*arguments):
    command = [sys.executable, "-m", "flowrep.view", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_a_scene_is_driven_drawn_filmed_and_counted(tmp_path):
    out = tmp_path / "seen"
    done = view("scene=three_way_junction", "driver=never_turn", *SMALL, f"hydra.run.dir={out}")
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


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("scene=s_turm", "unknown scene 's_turm' (did you mean 's_turn'?)"),
        ("driver=pilot", "unknown driver 'pilot'; there are: planner, never_turn, random"),
        ("path=up", "unknown path 'up'; there are: main"),
        ("episodes=0", "episodes should be a positive whole number, not 0"),
        ("interactive=true", "interactive=true needs a screen"),
    ],
)
def test_a_mistake_ends_in_one_line(override, expected, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    done = view(override, f"hydra.run.dir={tmp_path}")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {expected}")
    assert done.stderr.count("\n") == 1
