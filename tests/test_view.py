"""`python -m flowrep.view` from start to pictures, and its window."""

import sys
from contextlib import closing

import imageio.v3 as imageio
import matplotlib
import matplotlib.pyplot as plt
import pytest
import torch
from matplotlib.backend_bases import CloseEvent, KeyEvent
from tensordict import TensorDict

pytest.importorskip("pybullet", reason="the command needs the simulator")

from flowrep.config.schema import ViewConfig, validated
from flowrep.experiment.agents import Agent
from flowrep.experiment.film import LEGEND_S, Film
from flowrep.experiment.window import Keyboard, drive_by_hand
from flowrep.scenes import load_scene
from flowrep.tables import read_rows
from flowrep.usage import UsageError
from flowrep.view import (
    FILES,
    agent_of,
    category_rows,
    drive_on,
    episodes_of,
    folder_of,
    main,
    moments,
    moving_pixels,
)
from flowrep.view import view as show
from tests.config.composing import composed, plain
from tests.viz.test_video import full_after

SMALL = ["scene.camera.height_px=24", "scene.camera.width_px=32", "episodes=2", "sheet_rows=2"]
NO_OP, LEFT, RIGHT = 0, 1, 2


def options_of(config):
    return episodes_of(config, config.scene)


def driven(config, is_scene_given=True):
    return drive_on(config, agent_of(config, is_scene_given), options_of(config))


def asked(*overrides):
    return validated(ViewConfig, plain("view", *overrides))


@pytest.mark.slow
def test_a_scene_is_driven_drawn_filmed_and_counted(tmp_path, monkeypatch):
    out = tmp_path / "seen"
    short = ["scene=three_way_junction", "scene.time_limit_steps=12", "policy=never_turn"]
    monkeypatch.setattr(sys, "argv", ["view", *short, *SMALL, f"output={out}"])
    main()
    assert {path.name for path in out.iterdir()} == {*FILES}
    first, second = read_rows(out / "episodes.csv")
    assert (first["outcome"], first["hit"], first["length"]) == ("timeout", "", "12")
    assert [first["episode_seed"], second["episode_seed"]] == ["0", "1"]
    seen = {row["category"]: int(row["pixels"]) for row in read_rows(out / "categories.csv")}
    assert len(seen) == 11
    assert min(seen["road"], seen["sky"], seen["pedestrian"], seen["tree"]) > 0
    frames = imageio.imread(out / "episode.mp4", plugin="FFMPEG")
    # legend, every frame with the last one, which stays for a second: 12 frames
    assert len(frames) == 12 * LEGEND_S + int(first["length"]) + 12
    # Six tiles of 32 x 24, enlarged by a whole factor to some 240 px each.
    assert frames.shape[2] > 6 * 200


@pytest.mark.slow
def test_a_run_and_a_policy_of_ones_own_drive_as_baselines_do(tmp_path):
    from tests.test_evaluate import saved

    run = saved(tmp_path / "run", "representations=[obj]")
    path = tmp_path / "mine.py"
    path.write_text("def make(task):\n    return lambda maps: [0] * len(maps)\n")
    ended = {}
    for policy, scene in ((str(run.path), "straight_road"), (f"{path}:make", "s_turn")):
        maps = ["representations=[seg]"] if policy.endswith(":make") else []
        config = asked(f"policy={policy}", "scene=s_turn", "episodes=3", *maps)
        agent = agent_of(config, is_scene_given=False)
        film = Film(agent)
        assert film.street.scene.name == scene  # a run's agent is at home in its own
        film.close()
        ended[policy] = drive_on(config, agent, options_of(config))
        assert [episode.episode_seed for episode in ended[policy]] == [0, 1, 2]
    never = driven(asked("policy=never_turn", "scene=s_turn", "episodes=3"))
    assert [e.outcome for e in ended[f"{path}:make"]] == [e.outcome for e in never]


def test_a_view_has_the_speed_and_the_frame_rate_that_were_asked_for():
    (episode,) = driven(asked("fps=6", "speed=high", "scene.time_limit_steps=12", "episodes=1"))
    assert (episode.fps, episode.speed) == (6.0, "high")
    (episode,) = driven(asked("scene.frame_rate_hz=8", "scene.time_limit_steps=12", "episodes=1"))
    assert (episode.fps, episode.speed) == (8.0, "normal")


def test_a_folder_belongs_to_a_scene_and_a_policy():
    scenes = [load_scene(name) for name in ("straight_road", "s_turn")]
    policies = "planner", "outputs/a run/", "outputs/another", "../mine.py:make"
    folders = {folder_of(asked(f"policy='{p}'"), s) for p in policies for s in scenes}
    assert len(folders) == 8
    assert {folder.parent.parent.as_posix() for folder in folders} == {"outputs/view"}
    assert folder_of(asked("output=here"), scenes[0]).as_posix() == "here"


def test_a_view_replaces_the_files_of_an_earlier_one_and_no_others(tmp_path):
    for name in (*FILES, "notes.txt"):
        (tmp_path / name).write_text("old")
    config = asked("scene.time_limit_steps=3", *SMALL, "episodes=1", "video=false")
    agent = agent_of(config, is_scene_given=True)
    with closing(Film(agent)) as film:
        show(config, agent, film, episodes_of(config, film.street.scene), tmp_path)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {*FILES, "notes.txt"} - {"episode.mp4"}
    assert [path.name for path in tmp_path.iterdir() if path.read_bytes() == b"old"] == [
        "notes.txt"
    ]


@pytest.mark.slow
def test_a_full_disk_leaves_the_earlier_view_whole(tmp_path):
    (tmp_path / "sheet.png").write_text("old")
    config = asked("scene.time_limit_steps=20", *SMALL, "episodes=1")
    agent = agent_of(config, is_scene_given=True)
    with closing(Film(agent)) as film:
        options = episodes_of(config, film.street.scene)
        with full_after(5_000), pytest.raises(OSError, match=r"episode\.mp4"):
            show(config, agent, film, options, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.png"]
    assert (tmp_path / "sheet.png").read_text() == "old"


def test_a_refused_view_leaves_no_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for wrong in ("policy=pilot", "path=up", "speed=fast"):
        monkeypatch.setattr(sys, "argv", ["view", wrong])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 2
        assert wrong.partition("=")[0] in capsys.readouterr().err
        assert not [*tmp_path.iterdir()]


def test_a_policy_of_ones_own_needs_its_representations():
    with pytest.raises(UsageError, match="representations"):
        driven(asked("policy=mine:make"))


def test_the_path_can_be_chosen():
    config = asked("policy=never_turn", "scene=three_way_junction", "path=right", "episodes=6")
    assert [episode.path for episode in driven(config)] == ["right"] * 6


def test_pixels_are_counted_by_category():
    maps = [torch.tensor([[ids]], dtype=torch.uint8) for ids in ([0, 1, 1, 9], [1, 1, 1, 1])]
    # 8 pixels: 1 of sky (id 0), 6 of road (id 1), 1 of a car (id 9); the road is in both pictures.
    assert category_rows(("sky", "road", "car"), maps) == [
        {"category": "sky", "pixels": 1, "pixels_percent": 12.5, "pictures_percent": 50.0},
        {"category": "road", "pixels": 6, "pixels_percent": 75.0, "pictures_percent": 100.0},
        {"category": "car", "pixels": 1, "pixels_percent": 12.5, "pictures_percent": 50.0},
    ]


@pytest.mark.parametrize(
    ("motion", "rows", "expected"),
    [
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


# The window.


def never(tensordict):
    return tensordict.set("action", torch.full(tensordict.shape, NO_OP))


def action_of(keyboard):
    return int(keyboard(TensorDict({}, [1]))["action"])


def test_a_key_acts_while_it_is_held():
    keyboard = Keyboard(never, "never_turn")
    assert action_of(keyboard) == NO_OP
    keyboard.press("left")
    assert action_of(keyboard) == LEFT
    keyboard.press("right")  # both at once cancel
    assert action_of(keyboard) == NO_OP
    keyboard.release("left")
    assert action_of(keyboard) == RIGHT
    keyboard.press("S")  # another drives, whatever is held
    assert (keyboard.driver, action_of(keyboard)) == ("never_turn", NO_OP)
    keyboard.press("s")
    assert (keyboard.driver, action_of(keyboard)) == ("you", RIGHT)
    keyboard.release("right")
    keyboard.release(None)
    assert action_of(keyboard) == NO_OP


@pytest.fixture
def film():
    scene = composed("debug=smoke").scene
    film = Film(Agent.load("planner", scene=scene, device="cpu"))
    yield film
    film.close()


def drive_with_keys(film, keys):
    """Drives in a window; at each pause the next key is pressed, None presses none."""
    seen, keys = [], iter(keys)

    def pause(seconds):
        figure = plt.gcf()
        episode = film.street.episode
        title = figure._suptitle.get_text()
        seen.append((title, episode.seed, episode.steps, episode.now.vehicle.yaw_rad))
        key = next(keys, "q")
        if key == "close":
            figure.canvas.callbacks.process("close_event", CloseEvent("close_event", figure.canvas))
        elif key:
            event = KeyEvent("key_press_event", figure.canvas, key)
            figure.canvas.callbacks.process("key_press_event", event)

    with matplotlib.rc_context({"backend": "agg"}):
        drive_by_hand(Keyboard(never, "planner"), film, {"episode_seed": 1}, pause)
    return seen


def test_the_window_hears_the_keys_and_an_ended_episode_waits_for_r(film):
    seen = drive_with_keys(film, ["left", *[None] * 40, "r", None])
    assert [steps for _, _, steps, _ in seen[:4]] == [0, 1, 2, 3]
    assert seen[3][3] > 0  # left turns left
    ended = [title for title, *_ in seen if title.startswith("out of bounds")]
    assert "return -4." in ended[0]
    (_, seed, steps, _), last = seen[-2:][0], seen[-1]
    assert (seed, steps, last[1]) == (2, 0, 2)


def test_an_episode_can_be_left_for_the_next_and_the_window_be_closed(film):
    seen = drive_with_keys(film, [None, "r", None, "close"])
    assert [(seed, steps) for _, seed, steps, _ in seen] == [(1, 0), (1, 1), (2, 0), (2, 1)]


def test_without_a_screen_one_line_says_what_is_missing(film):
    with (
        matplotlib.rc_context({"backend": "agg"}),
        pytest.raises(UsageError, match=r"^interactive=true .*screen.*$"),
    ):
        drive_by_hand(Keyboard(never, "never_turn"), film, {"episode_seed": 1})


def test_a_scene_of_a_trained_agent_is_not_changed_unless_it_is_named(
    tmp_path, monkeypatch, capsys
):
    (tmp_path / "config.yaml").touch()  # a run's folder
    typed = [f"policy={tmp_path}", "scene.time_limit_steps=4"]
    monkeypatch.setattr(sys, "argv", ["flowrep-view", *typed])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert "scene.time_limit_steps= changes a scene: add scene=" in capsys.readouterr().err
