import csv

import pytest

from flowrep.experiment.run_folder import EVALUATION_COLUMNS, RunFolder
from flowrep.experiment.tables import append_rows


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_metrics_go_to_csv_and_tensorboard(tmp_path):
    run = RunFolder(tmp_path / "run")
    run.log_metrics(10, {"alpha": 0.5})
    run.log_metrics(20, {"alpha": 0.25})
    assert rows_of(run.metrics_path) == [
        {"frames": "10", "alpha": "0.5"},
        {"frames": "20", "alpha": "0.25"},
    ]
    assert list(run.path.rglob("events.out.tfevents.*"))


def test_a_resumed_run_drops_the_rows_it_will_write_again(tmp_path):
    run = RunFolder(tmp_path)
    for frames in (10, 20, 30):
        run.log_metrics(frames, {"alpha": 1 / frames})
    run.forget_after(20)
    assert [row["frames"] for row in rows_of(run.metrics_path)] == ["10", "20"]
    run.forget_after(5)
    run.log_metrics(10, {"alpha": 0.5})
    assert [row["frames"] for row in rows_of(run.metrics_path)] == ["10"]


def test_a_column_that_the_table_lacks_is_refused(tmp_path):
    append_rows(tmp_path / "t.csv", [{"a": 1}])
    with pytest.raises(ValueError, match="b"):
        append_rows(tmp_path / "t.csv", [{"a": 2, "b": 3}])


def test_config_comes_back_as_written(tmp_path):
    config = {"scene": {"camera": {"height_px": 48}}, "representations": {"ego": None}, "seed": 3}
    run = RunFolder(tmp_path)
    run.write_config(config)
    assert RunFolder.existing(tmp_path).read_config() == config


def test_a_folder_without_a_run_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no run"):
        RunFolder.existing(tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()


def test_an_older_table_of_episodes_gains_the_columns_it_lacks(tmp_path):
    run = RunFolder(tmp_path)
    new = dict.fromkeys(EVALUATION_COLUMNS, "1") | {"outcome": "collision", "hit": "car"}
    old = {name: value for name, value in new.items() if name != "hit"}
    append_rows(run.evaluation_path, [old])
    run.log_episodes([new])
    assert run.read_episodes() == [old | {"hit": ""}, new]
    with run.evaluation_path.open(newline="") as file:
        assert tuple(next(csv.reader(file))) == EVALUATION_COLUMNS
