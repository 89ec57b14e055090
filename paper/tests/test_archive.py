"""The runs of a study in a file: what comes back, and that it is written once."""

import json

import numpy as np
import pytest

pytest.importorskip("scipy", reason="reports are an extra")

from flowrep.experiment.run import RunFolderError
from flowrep.report.runs import read_run, read_runs
from paper import archive
from paper.archive import read_archive, read_archives, write_archive
from tests.report.folders import config_of, rows_of, run_in, write_run


def test_packed_runs_are_the_runs_of_the_folders(tmp_path):
    config = config_of("s_turn", "raw")
    metrics = [{"frames": 123456, "success": ""}, {"frames": 200000, "success": 0.25}]
    write_run(tmp_path / "runs" / "a", config, rows_of(config, "sct", fps=6.5), metrics)
    machine = {"commit": "abc", "precision": "bfloat16", "started": "1", "ended": "2"}
    machines = [machine, machine | {"precision": "float32", "started": "3", "ended": "4"}]
    path = run_in(tmp_path / "runs", "b", seed=1) / "machine.json"
    path.write_text(json.dumps(machines))
    folders, _ = read_runs([tmp_path / "runs"])
    write_archive(folders, tmp_path / "new" / "study.zip")
    packed = read_archives(tmp_path / "new")
    assert [run.name for run in packed] == ["a", "b"]
    for first, second in zip(folders, packed):
        assert first.config == second.config
        np.testing.assert_equal(first.episodes, second.episodes)
        np.testing.assert_equal(first.metrics, second.metrics)
    # it was resumed on another
    machine = packed[1].machine
    assert machine["precision"] == "bfloat16 | float32"
    assert (machine["started"], machine["ended"]) == ("1", "4")


def test_a_study_is_written_once_and_the_same_runs_give_the_same_bytes(tmp_path):
    run = read_run(run_in(tmp_path, "a"))
    for name in ("one.zip", "two.zip"):
        write_archive([run], tmp_path / name)
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()
    with pytest.raises(RunFolderError, match=r"one\.zip"):
        write_archive([read_run(run_in(tmp_path, "b"))], tmp_path / "one.zip")
    assert [packed.name for packed in read_archive(tmp_path / "one.zip")] == ["a"]


def test_two_runs_of_one_name_are_refused_in_a_study_and_in_two(tmp_path):
    runs = [read_run(run_in(tmp_path / sweep, "s0", 6)) for sweep in ("a", "b")]
    with pytest.raises(RunFolderError, match="two runs are named s0"):
        write_archive(runs, tmp_path / "packed.zip")
    for run, name in zip(runs, ("a.zip", "b.zip")):
        write_archive([run], tmp_path / "packed" / name)
    with pytest.raises(RunFolderError, match="two runs are named s0"):
        read_archives(tmp_path / "packed")


def test_a_study_that_would_fill_the_memory_is_refused(tmp_path, monkeypatch):
    write_archive([read_run(run_in(tmp_path, "a"))], tmp_path / "study.zip")
    monkeypatch.setattr(archive, "MOST_BYTES", 1_000)
    with pytest.raises(RunFolderError, match=r"study\.zip.* bytes"):
        read_archive(tmp_path / "study.zip")
