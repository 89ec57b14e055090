"""Folders in, runs and lines about what is wrong out; no two configs are ever taken for one."""

import pytest
import yaml

pytest.importorskip("scipy", reason="reports are an extra")

from flowrep.experiment.run import RunFolderError
from flowrep.report.families import families_of
from flowrep.report.runs import read_runs
from tests.report.folders import config_of, letters, rows_of, write_run


def run_in(folder, name, successes=4, *, scene="straight_road", stack="ego+obj", seed=0, **changes):
    config = config_of(scene, stack, seed, **changes)
    return write_run(folder / name, config, rows_of(config, letters(successes)))


def labels(*folders):
    runs, _ = read_runs(folders)
    return {family.label: sorted(r.path.name for r in family.runs) for family in families_of(runs)}


def test_runs_are_found_however_deep_and_once(tmp_path):
    run_in(tmp_path / "day" / "sweep", "a")
    run_in(tmp_path / "day", "b", seed=1)
    (tmp_path / "day" / "b" / ".hydra").mkdir()
    (tmp_path / "day" / "b" / ".hydra" / "config.yaml").write_text("seed: 1\n")
    runs, complaints = read_runs([tmp_path, tmp_path / "day" / "b"])
    assert [run.path.name for run in runs] == ["b", "a"]
    assert complaints == []


@pytest.mark.parametrize("name", ["wandb", ".hydra"])
def test_a_folder_of_runs_may_lie_anywhere(tmp_path, name):
    path = run_in(tmp_path / name / "sweep", "a")
    (path / name).mkdir()
    (path / name / "config.yaml").write_text("seed: 1\n")
    for folder in (tmp_path / name, path):
        runs, complaints = read_runs([folder])
        assert [run.path for run in runs] == [path]
        assert complaints == []


def test_what_a_run_is_comes_from_its_config(tmp_path):
    run_in(tmp_path, "misnamed_ego_s7", stack="obj+seg2+ego", seed=3, scene="s_turn")
    (run,), _ = read_runs([tmp_path])
    assert (run.scene, run.stack, run.seed, run.fps) == ("s_turn", "ego+obj+seg2", 3, 12.0)


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("config.yaml", "seed: [", "config.yaml can't be read"),
        ("config.yaml", "", "config.yaml is empty"),
        ("config.yaml", "seed: 1\n", "config.yaml has no scene"),
        ("config.yaml", "seed: 2026-13-45\n", "config.yaml can't be read"),
        ("config.yaml", "[" * 5000, "config.yaml can't be read"),
        ("evaluation.csv", "scene;fps\n1;2\n", "evaluation.csv lacks the columns"),
        ("metrics.csv", "frames,success\nmany,0.5\n", "line 2: frames can't be 'many'"),
        ("metrics.csv", "frames,success\n9,high\n", "line 2: success can't be 'high'"),
    ],
)
def test_a_damaged_folder_is_one_line_and_the_others_are_read(tmp_path, file, text, expected):
    run_in(tmp_path, "good")
    (run_in(tmp_path, "bad", seed=1) / file).write_text(text)
    runs, (complaint,) = read_runs([tmp_path])
    assert [run.path.name for run in runs] == ["good"]
    assert expected in complaint
    assert "\n" not in complaint


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("fps", "inf"),
        ("fps", "nan"),
        ("fps", "0"),
        ("speed", "fast"),
        ("outcome", "running"),
        ("length", ""),
    ],
)
def test_a_cell_that_no_episode_can_have_is_one_line(tmp_path, column, value):
    run_in(tmp_path, "good")
    config = config_of(seed=1)
    first, *rows = rows_of(config, "ssss")
    write_run(tmp_path / "bad", config, [*rows, first | {column: value}])
    runs, (complaint,) = read_runs([tmp_path])
    assert [run.path.name for run in runs] == ["good"]
    said = f"bad/evaluation.csv, line 5: {column} can't be '{value}'; correct or delete the line"
    assert complaint.endswith(said)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"representations": {5: {}, "ego": {}}}, "a name in representations is 5"),
        ({"representations": {"ego\nobj": {}}}, r"a name in representations is 'ego\nobj'"),
        ({"scene__name": "\x1b[2J"}, r"scene.name is '\x1b[2J'"),
        ({"scene__frame_rate_hz": float("inf")}, "scene.frame_rate_hz is inf"),
        ({"scene__frame_rate_hz": float("nan")}, "scene.frame_rate_hz is nan"),
        ({"scene__frame_rate_hz": -12.0}, "scene.frame_rate_hz is -12.0"),
        ({"scene__frame_rate_hz": 10**400}, "is not what a run leaves"),
        ({"speed": "fast"}, "speed is 'fast'"),
        ({"seed": True}, "seed is True"),
        ({"experiment": "\ud800"}, "is not what a run leaves"),
    ],
)
def test_a_config_that_no_run_can_have_is_one_line(tmp_path, changes, said):
    run_in(tmp_path, "good", stack="raw")
    config = config_of(seed=1, stack="raw")
    path = write_run(tmp_path / "bad", config, rows_of(config, "s"))
    (path / "config.yaml").write_text(yaml.safe_dump(config_of(**changes)))
    runs, (complaint,) = read_runs([tmp_path])
    assert [run.path.name for run in runs] == ["good"]
    assert f"{path}/config.yaml" in complaint
    assert said in complaint


@pytest.mark.parametrize("key", ["speed", "scene__name", "scene__frame_rate_hz", "total_frames"])
@pytest.mark.parametrize("value", ["gone", [1], None])
def test_a_config_that_is_not_a_runs_is_one_line(tmp_path, key, value):
    path = run_in(tmp_path, "bad")
    config = config_of(**{key: value})
    if value == "gone":
        *sections, last = key.split("__")
        section = config
        for name in sections:
            section = section[name]
        del section[last]
    (path / "config.yaml").write_text(yaml.safe_dump(config))
    runs, complaints = read_runs([tmp_path])
    assert runs == []
    assert len(complaints) == 1
    assert "bad/config.yaml" in complaints[0]


@pytest.mark.parametrize(("name", "said"), [("none", "does not exist"), ("empty", "holds no run")])
def test_a_folder_without_runs_is_named(tmp_path, name, said):
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunFolderError, match=f"{name}' {said}"):
        read_runs([tmp_path / name])


def test_a_run_that_is_there_twice_counts_as_one_seed(tmp_path):
    run_in(tmp_path, "first")
    config = config_of(device="cuda")  # of the machine
    rows = rows_of(config, letters(5)) + rows_of(config, letters(5), speed="low")
    write_run(tmp_path / "second", config, rows)
    runs, (complaint,) = read_runs([tmp_path])
    assert [run.path.name for run in runs] == ["second"]  # which has more episodes
    assert "first is the same run as" in complaint


def test_an_unfinished_run_has_no_tested_episodes(tmp_path):
    config = config_of()
    rows = [row | {"frames": 400} for row in rows_of(config, "ss")]
    write_run(tmp_path / "half", config, rows)
    (run,), _ = read_runs([tmp_path])
    assert (run.is_finished, run.frames, run.tested) == (False, 400, [])


def test_episodes_of_training_and_of_other_scenes_are_not_tests(tmp_path):
    config = config_of()
    rows = rows_of(config, "ss", evaluation="training")
    rows += rows_of(config, "cc", scene="s_turn") + rows_of(config, "sc", evaluation="final")
    write_run(tmp_path / "run", config, rows)
    (run,), _ = read_runs([tmp_path])
    assert [row["outcome"] for row in run.tested] == ["success", "collision"]


def test_runs_of_one_config_are_one_family_over_scenes_stacks_and_seeds(tmp_path):
    run_in(tmp_path, "a")
    run_in(tmp_path, "b", seed=1, stack="seg2")
    run_in(tmp_path, "c", scene="s_turn", experiment="flow_composition", num_workers=4)
    assert labels(tmp_path) == {"": ["a", "b", "c"]}


@pytest.mark.parametrize(
    ("key", "value", "label"),
    [
        ("algorithm__tau", 0.005, "algorithm.tau"),
        ("total_frames", 2000, "total_frames"),
        ("flow__source", "estimated", "flow.source"),
        ("scene__camera__width_px", 84, "scene.camera.width_px"),
        ("scene__time_limit_steps", 90, "scene.straight_road.time_limit_steps"),
        ("representations__obj__scale", 2.5, "representations.obj.scale"),
    ],
)
def test_runs_whose_configs_differ_are_apart_and_the_key_is_named(tmp_path, key, value, label):
    base = {"representations__obj": {"scale": 1.0}}
    run_in(tmp_path, "a", **base)
    run_in(tmp_path, "b", seed=1, **base)
    run_in(tmp_path, "c", seed=2, **base, **{key: value})
    found = labels(tmp_path)
    assert sorted(found.values()) == [["a", "b"], ["c"]]
    assert f"{label}={value}" in found


def test_a_whole_number_is_the_same_with_and_without_a_point(tmp_path):
    ranges = {"scene__pedestrian_speed_mps": {"normal": [1, 2.5]}}
    run_in(tmp_path, "a", algorithm__tau=1, **ranges)
    ranges = {"scene__pedestrian_speed_mps": {"normal": [1.0, 2.5]}}
    run_in(tmp_path, "b", seed=1, algorithm__tau=1.0, **ranges)
    assert labels(tmp_path) == {"": ["a", "b"]}


def test_a_run_without_a_key_that_differs_stands_beside_both(tmp_path):
    run_in(tmp_path, "one", representations__obj={"scale": 1.0})
    run_in(tmp_path, "two", representations__obj={"scale": 2.0})
    run_in(tmp_path, "seg2", stack="seg2")
    assert labels(tmp_path) == {
        "representations.obj.scale=1": ["one", "seg2"],
        "representations.obj.scale=2": ["seg2", "two"],
    }


@pytest.mark.parametrize(
    ("key", "value", "label"),
    [
        ("scene__obstacles", ["car"], "scene.straight_road.obstacles"),
        ("algorithm__beta", 2, "algorithm.beta"),
        ("scene__camera__roll_deg", 3, "scene.camera.roll_deg"),
    ],
)
def test_an_option_that_only_some_runs_have_keeps_them_apart(tmp_path, key, value, label):
    run_in(tmp_path, "a")
    run_in(tmp_path, "b", **{key: value})
    run_in(tmp_path, "c", seed=1)
    assert labels(tmp_path) == {f"{label}=absent": ["a", "c"], f"{label}={value}": ["b"]}


def test_the_options_of_another_flow_or_algorithm_are_no_difference_of_their_own(tmp_path):
    ours = {"algorithm___target_": "flowrep.agent.SAC"}
    run_in(tmp_path, "a", **ours)
    run_in(tmp_path, "b", **ours, flow__source="estimated", flow__preset="fast")
    run_in(tmp_path, "c", algorithm__beta=2, algorithm___target_="my.Algorithm")
    assert labels(tmp_path) == {
        "flow.source=exact, algorithm._target_=flowrep.agent.SAC": ["a"],
        "flow.source=estimated, algorithm._target_=flowrep.agent.SAC": ["b"],
        "flow.source=exact, algorithm._target_=my.Algorithm": ["c"],
    }


def test_many_keys_that_differ_make_a_short_label(tmp_path):
    run_in(tmp_path, "a")
    changes = {"total_frames": 5, "num_envs": 3, "speed": "low", "algorithm__tau": 1.0}
    run_in(tmp_path, "b", **changes, flow__source="estimated")
    (long,) = [label for label in labels(tmp_path) if "estimated" in label]
    assert long.endswith(", 2 more keys")
