"""Folders and packed tables in, runs and lines about what is wrong out."""

import gzip
import json
import os

import numpy as np
import pytest
import yaml

pytest.importorskip("scipy", reason="reports are an extra")

from flowrep.experiment.lock import RunFolderError
from flowrep.report.storage import (
    EPISODES,
    RUNS,
    TRAINING,
    read_archive,
    read_run,
    read_runs,
    without_repeats,
    write_archive,
)
from tests.report.folders import config_of, letters, rows_of, run_in, write_run


def names(runs):
    return [run.folder.name for run in runs]


@pytest.mark.parametrize("name", ["wandb", ".hydra"])
def test_runs_are_found_wherever_they_lie_and_once(tmp_path, name):
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
        ("machine.json", "[{", "machine.json"),
        ("machine.json", "[1]", "machine.json"),
    ],
)
def test_a_damaged_folder_is_one_line_and_the_others_are_read(tmp_path, file, text, expected):
    run_in(tmp_path, "good")
    (run_in(tmp_path, "bad", seed=1) / file).write_text(text)
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


def test_packed_runs_are_the_runs_of_the_folders(tmp_path):
    config = config_of("s_turn", "raw")
    metrics = [{"frames": 123456, "success": ""}, {"frames": 200000, "success": 0.25}]
    write_run(tmp_path / "runs" / "a", config, rows_of(config, "sct", fps=6.5), metrics)
    machines = [{"commit": "abc", "precision": p, "cpu": "x"} for p in ("bfloat16", "float32")]
    path = run_in(tmp_path / "runs", "b", seed=1) / "machine.json"
    path.write_text(json.dumps(machines))
    folders, _ = read_runs([tmp_path / "runs"])
    write_archive(folders, tmp_path / "packed")
    packed, warnings = read_runs([tmp_path / "packed"])
    assert ([run.name for run in packed], warnings) == (["a", "b"], [])
    for first, second in zip(folders, packed):
        assert first.config == second.config
        np.testing.assert_equal(first.episodes, second.episodes)
        np.testing.assert_equal(first.metrics, second.metrics)
    assert set(packed[0].machine.values()) == {"unknown"}
    both = {"commit": "abc", "precision": "bfloat16 | float32", "cpu": "x"}
    assert packed[1].machine == both  # it was resumed on another


def test_packing_again_adds_and_replaces_and_gives_the_same_bytes(tmp_path):
    first = read_run(run_in(tmp_path / "one", "a", 4))
    write_archive([first], tmp_path / "packed")
    before = (tmp_path / "packed" / EPISODES).read_bytes()
    write_archive([first], tmp_path / "packed")
    assert (tmp_path / "packed" / EPISODES).read_bytes() == before
    better, other = read_run(run_in(tmp_path / "two", "a", 5)), read_run(run_in(tmp_path, "b"))
    write_archive([better, other], tmp_path / "packed")
    rows = gzip.decompress((tmp_path / "packed" / EPISODES).read_bytes()).decode().splitlines()
    assert sum(row.startswith("a,") and ",success," in row for row in rows) == 5
    assert sum(row.startswith("b,") for row in rows) == 8


@pytest.mark.parametrize("name", [RUNS, EPISODES, TRAINING])
@pytest.mark.parametrize("damage", ["cut", "text", "gone"])
def test_damaged_packed_runs_are_named(tmp_path, name, damage):
    packed = tmp_path / "packed"
    write_archive([read_run(run_in(tmp_path, "a"))], packed)
    data = (packed / name).read_bytes()
    (packed / name).write_bytes({"cut": data[: len(data) // 2], "text": b"}{\n"}.get(damage, data))
    if damage == "gone":
        (packed / name).unlink()
    with pytest.raises(RunFolderError, match="packed"):
        read_archive(packed)


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_packing_that_fails_leaves_what_was_there(tmp_path, monkeypatch, step):
    def fail(*_):
        raise OSError(28, "No space left on device")

    packed = tmp_path / "packed"
    write_archive([read_run(run_in(tmp_path, "a"))], packed)
    before = {path.name: path.read_bytes() for path in packed.iterdir()}
    other = read_run(run_in(tmp_path, "b"))
    monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match=f"'{packed}'"):
        write_archive([other], packed)
    assert {path.name: path.read_bytes() for path in packed.iterdir()} == before


def test_packed_runs_are_chosen_by_name(tmp_path):
    write_archive([read_run(run_in(tmp_path, name)) for name in ("ab", "ac", "b")], tmp_path / "p")
    runs, _ = read_runs([tmp_path / "p" / "a?"])
    assert [run.name for run in runs] == ["ab", "ac"]
    with pytest.raises(RunFolderError):
        read_runs([tmp_path / "p" / "z*"])


def test_an_outcome_that_is_not_known_is_named_and_its_run_left_out(tmp_path):
    run_in(tmp_path, "good")
    config = config_of(seed=1)
    rows = rows_of(config, "sss")
    rows[1]["outcome"] = "sucess"  # as a failure it would make this 2 of 3
    write_run(tmp_path / "bad", config, rows)
    runs, (warning,) = read_runs([tmp_path])
    assert names(runs) == ["good"]
    assert "/bad" in warning
    assert "'sucess'" in warning


def test_a_packed_run_with_an_unknown_outcome_is_named(tmp_path):
    run = read_run(run_in(tmp_path, "a"))
    run.episodes["outcome"][0] = "won"
    write_archive([run], tmp_path / "packed")
    with pytest.raises(RunFolderError, match=r"run a: .*'won'"):
        read_runs([tmp_path / "packed"])


def test_two_runs_of_one_name_are_not_packed_into_one(tmp_path):
    runs = [read_run(run_in(tmp_path / sweep, "s0", 6)) for sweep in ("a", "b")]
    with pytest.raises(RunFolderError, match="two runs are named s0"):
        write_archive(runs, tmp_path / "packed")
    assert not (tmp_path / "packed").exists()
