"""`python -m flowrep.view` from start to pictures."""

from contextlib import closing
from functools import partial

import imageio.v3 as imageio
import pytest
import torch

from flowrep import files
from flowrep.experiment.film import Film
from flowrep.scenes import load_scene
from flowrep.view import (
    FILES,
    agent_of,
    drive_on,
    episodes_of,
    folder_of,
    moments,
    moving_pixels,
    view,
)
from tests.config.composing import config_of
from tests.running import run_here
from tests.test_files import fails

asked = partial(config_of, "view")
SMALL = ["scene.camera.height_px=24", "scene.camera.width_px=32", "episodes=2", "sheet_rows=2"]


def driven(config):
    return drive_on(config, agent_of(config), episodes_of(config, config.scene))


def show(*overrides):
    config = asked("scene=s_turn", "scene.time_limit_steps=3", *SMALL, *overrides)
    agent = agent_of(config)
    with closing(Film(agent)) as film:
        view(config, agent, film)


@pytest.mark.slow
def test_a_scene_is_driven_drawn_and_filmed(tmp_path, monkeypatch, capsys):
    out = tmp_path / "seen"
    short = ["scene=three_way_junction", "scene.time_limit_steps=12", "policy=never_turn"]
    line = ["python", "-m", "flowrep.view", *short, *SMALL, f"output={out}"]
    assert run_here(monkeypatch, line) == 0
    assert {path.name for path in out.iterdir()} == {*FILES}
    assert capsys.readouterr().out.count("timeout") == 2
    frames = imageio.imread(out / "episode.mp4", plugin="FFMPEG")
    # every frame, and the last one for a second: 12 frames
    assert len(frames) == 12 + 12
    # Six tiles of 32 x 24, enlarged by a whole factor to some 240 px each.
    assert frames.shape[2] > 6 * 200


@pytest.mark.slow
def test_a_run_drives_in_its_scene_and_a_policy_from_a_file_in_the_one_asked_for(tmp_path):
    from tests.test_evaluate import saved

    run = saved(tmp_path / "run", "representations=[obj]")
    path = tmp_path / "mine.py"
    path.write_text("def make(task):\n    return lambda maps: [0] * len(maps)\n")
    ended = {}
    from_file = ["scene=s_turn", "representations=[seg]"]
    cases = (str(run.path), "straight_road", []), (f"{path}:make", "s_turn", from_file)
    for policy, scene, given in cases:
        config = asked(f"policy={policy}", "episodes=3", *given)
        agent = agent_of(config)
        film = Film(agent)
        assert film.street.scene.name == scene  # a run's agent is at home in its own
        film.close()
        ended[policy] = drive_on(config, agent, episodes_of(config, agent.config.scene))
        assert [episode.episode_seed for episode in ended[policy]] == [0, 1, 2]
    never = driven(asked("policy=never_turn", "scene=s_turn", "episodes=3"))
    assert [e.outcome for e in ended[f"{path}:make"]] == [e.outcome for e in never]


@pytest.mark.parametrize(
    ("line", "fps", "speed"),
    [
        ("path=eastward fps=6 speed=high", 6.0, "high"),
        ("path=eastward scene.frame_rate_hz=8", 8.0, "normal"),
    ],
)
def test_a_view_has_the_path_the_speed_and_the_frame_rate_asked_for(line, fps, speed):
    short = "scene=s_turn", "scene.time_limit_steps=12", "episodes=6"
    ended = driven(asked(*short, *line.split()))
    assert [(x.path, x.fps, x.speed) for x in ended] == 6 * [("eastward", fps, speed)]


def test_each_scene_and_policy_has_a_folder():
    scenes = [load_scene(name) for name in ("straight_road", "s_turn")]
    policies = "planner", "outputs/a run/", "outputs/another", "../mine.py:make"
    folders = {folder_of(asked(f"policy='{p}'"), s) for p in policies for s in scenes}
    assert len(folders) == 8
    assert {folder.parent.parent.as_posix() for folder in folders} == {"outputs/view"}
    assert folder_of(asked("output=here"), scenes[0]).as_posix() == "here"


def test_a_view_replaces_the_files_of_an_earlier_one_once_the_disk_has_room_and_no_others(tmp_path):
    for name in (*FILES, "notes.txt"):
        (tmp_path / name).write_text("old")

    def old():
        return {path.name for path in tmp_path.iterdir() if path.read_bytes() == b"old"}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "_flush", fails)
        with pytest.raises(OSError, match=r"sheet\.png"):
            show("video=false", f"output={tmp_path}")
    assert old() == {*FILES, "notes.txt"}
    show("video=false", f"output={tmp_path}")
    assert old() == {"notes.txt"}
    assert {path.name for path in tmp_path.iterdir()} == {*FILES, "notes.txt"} - {"episode.mp4"}


def test_a_path_that_the_scene_does_not_have_is_refused_before_a_folder_is_made(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert run_here(monkeypatch, ["python", "-m", "flowrep.view", "path=up"]) == 2
    assert "path" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


def test_a_sheet_shows_the_moment_with_most_motion_of_each_part():
    assert moments([5, 1, 1], 1) == [0]
    assert moments([1, 2], 6) == [0, 1]  # fewer frames than rows: each of them once


def test_only_moving_pixels_beyond_four_metres_count_for_the_sheet():
    obj = torch.zeros(2, 1, 4)
    obj[1, 0, 1:] = 0.5  # v alone
    depth = torch.tensor([[[9.0, 3.0, 9.0, torch.inf]]])
    assert moving_pixels({"obj": obj, "depth": depth}) == 2
