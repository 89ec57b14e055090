"""What a run is, and which runs may be compared: no two configs are ever taken for one."""

from typing import get_args

import pytest

pytest.importorskip("scipy", reason="reports are an extra")

from flowrep.choices import BaselineName
from flowrep.report.runs import DRAWN_BASELINES, groups_of
from flowrep.report.storage import read_run, read_runs
from tests.report.folders import config_of, rows_of, run_in, write_run


def labels(folder):
    runs, _ = read_runs([folder])
    return {group.label: sorted(r.folder.name for r in group.runs) for group in groups_of(runs)}


def test_every_baseline_is_drawn():
    assert set(DRAWN_BASELINES) == set(get_args(BaselineName))


def test_what_a_run_is_comes_from_its_config(tmp_path):
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


def test_many_keys_that_differ_make_a_short_label(tmp_path):
    run_in(tmp_path, "a")
    changes = {"total_frames": 5, "num_envs": 3, "speed": "low", "algorithm__tau": 1.0}
    run_in(tmp_path, "b", **changes, flow__source="estimated")
    (long,) = [label for label in labels(tmp_path) if "estimated" in label]
    assert long.endswith(", 2 more keys")


def test_an_episode_that_was_evaluated_twice_counts_once(tmp_path):
    config = config_of()
    rows = rows_of(config, "ssc", evaluation="final") + rows_of(config, "sscc")
    run = read_run(write_run(tmp_path / "run", config, rows))
    assert sorted(run.episodes["episode_seed"][run.tested].tolist()) == [100, 101, 102, 103]
