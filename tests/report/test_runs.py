"""What a run is, how folders are read, and which runs may be compared: no two configs for one."""

import math

import pytest
import yaml

from flowrep.experiment.run import RunFolderError
from flowrep.report.runs import groups_of, read_run, read_runs, without_repeats
from tests.report.folders import config_of, letters, rows_of, run_in, write_run


def names(runs):
    return [run.folder.name for run in runs]


@pytest.mark.parametrize("name", ["wandb", ".hydra"])
def test_each_run_is_found_once_at_any_depth(tmp_path, name):
    # the name means nothing above a run; inside of one it is of what is no run
    run_in(tmp_path / name / "sweep", "a")
    inside = run_in(tmp_path / name, "b", seed=1) / name
    inside.mkdir()
    (inside / "config.yaml").write_text("seed: 1\n")
    runs, warnings = read_runs([tmp_path / name, tmp_path / name / "b"])
    assert (names(runs), warnings) == (["b", "a"], [])


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("config.yaml", "seed: [", "config.yaml"),
        ("config.yaml", "seed: 1\n", "scene"),
        ("config.yaml", yaml.safe_dump(config_of(total_frames=None)), "config.yaml"),
        ("evaluation.csv", "scene;fps\n1;2\n", "evaluation.csv"),
        ("metrics.csv", "frames,success\nmany,0.5\n", "'many'"),
        ("config.yaml", yaml.safe_dump(config_of(seed=math.inf)), "config.yaml"),
        ("evaluation.csv", ("success", "sucess"), "'sucess'"),  # it would count as a failure
        ("evaluation.csv", ("100", "9" * 26), "table"),  # the seed of an episode
    ],
)
def test_a_damaged_folder_is_one_line_and_the_others_are_read(tmp_path, file, text, expected):
    run_in(tmp_path, "good")
    bad = run_in(tmp_path, "bad", seed=1) / file
    bad.write_text(text if isinstance(text, str) else bad.read_text().replace(*text))
    runs, (warning,) = read_runs([tmp_path])
    assert names(runs) == ["good"]
    assert "/bad" in warning
    assert expected in warning
    assert "\n" not in warning


@pytest.mark.parametrize("name", ["none", "empty"])
def test_a_folder_without_runs_is_named(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunFolderError, match=name):
        read_runs([tmp_path / name])


def test_a_run_that_is_there_twice_counts_as_one_seed(tmp_path):
    run_in(tmp_path, "first")
    config = config_of(device="cuda")  # of the machine
    rows = rows_of(config, letters(5)) + rows_of(config, letters(5), speed="low")
    write_run(tmp_path / "second", config, rows)
    runs, (warning,) = without_repeats(read_runs([tmp_path])[0])
    assert names(runs) == ["second"]  # which has more episodes
    assert all(name in warning for name in ("first", "second"))


def labels(folder):
    runs, _ = read_runs([folder])
    return {group.label: sorted(r.folder.name for r in group.runs) for group in groups_of(runs)}


def test_scene_stack_and_seed_of_a_run_come_from_its_config_not_its_folder(tmp_path):
    path = run_in(tmp_path, "misnamed_ego_s7", stack="obj+seg2+ego", seed=3, scene="s_turn")
    run = read_run(path)
    assert (run.scene, run.stack, run.seed, run.fps) == ("s_turn", "ego+obj+seg2", 3, 12.0)


def test_episodes_of_training_and_of_other_scenes_are_not_tests(tmp_path):
    config = config_of()
    rows = rows_of(config, "ss", evaluation="training")
    rows += rows_of(config, "cc", scene="s_turn") + rows_of(config, "sc", evaluation="final")
    run = read_run(write_run(tmp_path / "run", config, rows))
    assert run.episodes["outcome"][run.tested].tolist() == ["success", "collision"]


def test_runs_of_one_config_are_one_group_over_scenes_stacks_and_seeds(tmp_path):
    run_in(tmp_path, "a")
    run_in(tmp_path, "b", seed=1, stack="seg2")
    run_in(tmp_path, "c", scene="s_turn", experiment="flow_composition", num_workers=4)
    assert labels(tmp_path) == {"": ["a", "b", "c"]}


@pytest.mark.parametrize(
    ("key", "value", "label"),
    [
        ("algorithm__tau", 0.005, "algorithm.tau"),
        ("total_frames", 2000, "total_frames"),
        ("scene__camera__width_px", 84, "scene.camera.width_px"),
        ("scene__time_limit_steps", 90, "scene.straight_road.time_limit_steps"),
        ("representations__obj__scale", 2.5, "representations.obj.scale"),
        ("scene__obstacles", ["car"], "scene.straight_road.obstacles"),  # absent from the others
        ("scene__camera__roll_deg", 3, "scene.camera.roll_deg"),
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
    run_in(tmp_path, "a", algorithm__tau=1, scene__pedestrian_speed_mps={"normal": [1, 2.5]})
    ranges = {"scene__pedestrian_speed_mps": {"normal": [1.0, 2.5]}}
    run_in(tmp_path, "b", seed=1, algorithm__tau=1.0, **ranges)
    assert labels(tmp_path) == {"": ["a", "b"]}


def test_an_episode_that_was_evaluated_twice_counts_once(tmp_path):
    config = config_of()
    rows = rows_of(config, "ssc", evaluation="final") + rows_of(config, "sscc")
    run = read_run(write_run(tmp_path / "run", config, rows))
    assert sorted(run.episodes["episode_seed"][run.tested].tolist()) == [100, 101, 102, 103]
