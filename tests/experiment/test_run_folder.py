import csv

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from flowrep.experiment.run_folder import EVALUATION_COLUMNS, RunFolder, RunFolderError
from flowrep.experiment.tables import TableError, append_rows

CONFIG = {
    "scene": {"camera": {"height_px": 48}},
    "representations": {"ego": None},
    "flow": {"source": "exact"},
    "noise": {"drift_m": 0.0},
    "algorithm": {"gamma": 0.5},
    "seed": 3,
    "num_envs": 2,
    "total_frames": 10,
}


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


def test_evaluations_go_to_tensorboard_as_shares_and_means(tmp_path):
    """Two of four succeed; returns 1, 2, 3 and 10, lengths 10, 20, 30 and 60."""
    run = RunFolder(tmp_path)
    same = {
        "scene": "s_turn", "representations": "ego", "flow": "exact", "seed": 3, "frames": 500,
        "evaluation": "training", "policy": "greedy", "speed": "normal", "fps": 12.0, "hit": "",
    }  # fmt: skip
    ends = [
        ("success", 1.0, 10),
        ("timeout", 2.0, 20),
        ("collision", 3.0, 30),
        ("success", 10.0, 60),
    ]
    rows = [
        same | {"episode_seed": k, "outcome": outcome, "return": total, "length": length}
        for k, (outcome, total, length) in enumerate(ends)
    ]
    run.log_episodes(rows)
    for logger in run._loggers:
        logger.experiment.flush()
    events = EventAccumulator(str(next(tmp_path.rglob("events.out.tfevents.*"))))
    events.Reload()
    title = "evaluation/s_turn/normal/12fps/greedy"
    plotted = {tag: events.Scalars(tag)[0] for tag in events.Tags()["scalars"]}
    assert {tag: event.value for tag, event in plotted.items()} == {
        f"{title}/success": 0.5,
        f"{title}/collision": 0.25,
        f"{title}/out_of_bounds": 0.0,
        f"{title}/timeout": 0.25,
        f"{title}/return": 4.0,
        f"{title}/length": 30.0,
    }
    assert {event.step for event in plotted.values()} == {500}


def test_a_resumed_run_drops_the_rows_it_will_write_again(tmp_path):
    run = RunFolder(tmp_path)
    for frames in (10, 20, 30):
        run.log_metrics(frames, {"alpha": 1 / frames})
    run.forget_after(20)
    assert [row["frames"] for row in rows_of(run.metrics_path)] == ["10", "20"]
    run.forget_after(5)
    run.log_metrics(10, {"alpha": 0.5})
    assert [row["frames"] for row in rows_of(run.metrics_path)] == ["10"]


@pytest.mark.parametrize(("frames", "kind"), [(17, "training"), (8, "final"), (8, "evaluate")])
def test_only_what_was_written_before_the_first_checkpoint_is_dropped_without_one(
    tmp_path, frames, kind
):
    run, config = RunFolder(tmp_path), {"checkpoint_every_frames": 15, "total_frames": 99}
    config["num_envs"] = 2
    for logged in (8, 16):
        run.log_metrics(logged, {"alpha": 1 / logged})
        run.log_episodes([episode(1, frames=str(logged), evaluation="training")])
    run.start_again(config)
    assert not run.metrics_path.exists()
    assert not run.evaluation_path.exists()
    run.log_metrics(8, {"alpha": 0.5})
    run.log_episodes([episode(1, frames=str(frames), evaluation=kind)])
    with pytest.raises(RunFolderError, match=r"latest\.safetensors is missing.*restore that file"):
        run.start_again(config)
    assert len(rows_of(run.metrics_path)) == len(run.read_episodes()) == 1


def test_a_column_that_the_table_lacks_is_refused(tmp_path):
    append_rows(tmp_path / "t.csv", [{"a": 1}])
    with pytest.raises(ValueError, match="b"):
        append_rows(tmp_path / "t.csv", [{"a": 2, "b": 3}])


def test_config_comes_back_as_written(tmp_path):
    run = RunFolder(tmp_path)
    run.write_config(CONFIG, ["seed=3"])
    assert RunFolder.existing(tmp_path).read_config() == CONFIG
    assert (tmp_path / ".hydra" / "overrides.yaml").read_text() == "- seed=3\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is empty"),
        ("- 1\n- 2\n", "holds a list"),
        ("seed: [1", "can't be read"),
        ("\x00", "can't be read"),
        ("seed: 2001-99-99", "can't be read"),
        ("[" * 500, "can't be read"),
        ("seed: 0\nscene: {name: s}\n", "has no representations"),
        ("seed:\n", "has no scene"),
    ],
    ids=["empty", "list", "half", "binary", "date", "deep", "a missing key", "a missing value"],
)
def test_a_damaged_config_is_named(tmp_path, text, says):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(RunFolderError, match=rf"config\.yaml {says}.*; restore the file"):
        RunFolder.existing(tmp_path).read_config()


def test_a_folder_without_a_run_is_named(tmp_path):
    with pytest.raises(RunFolderError, match="holds no run"):
        RunFolder.existing(tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()


def episode(seed, outcome="collision", **changes):
    row = dict.fromkeys(EVALUATION_COLUMNS, "1") | {"outcome": outcome, "episode_seed": str(seed)}
    return row | changes


@pytest.mark.parametrize("name", ["config.yaml", "metrics.csv", "evaluation.csv"])
def test_a_folder_that_holds_a_run_is_no_place_for_a_new_one(tmp_path, name):
    run = RunFolder(tmp_path)
    run.check_is_new()
    (tmp_path / name).write_text("something")
    with pytest.raises(RunFolderError, match=rf"holds a run already \({name}\).*hydra.run.dir="):
        run.check_is_new()


def test_a_folder_with_a_config_is_to_be_resumed(tmp_path):
    RunFolder(tmp_path).write_config(CONFIG)
    with pytest.raises(RunFolderError, match=f"continue it with resume={tmp_path}"):
        RunFolder(tmp_path).check_is_new()


def test_an_episode_that_is_evaluated_again_takes_its_place(tmp_path):
    run = RunFolder(tmp_path)
    run.log_episodes([episode(7), episode(8), episode(9)])
    before = run.evaluation_path.read_bytes()
    run.log_episodes([episode(8), episode(9)])
    assert run.evaluation_path.read_bytes() == before
    run.log_episodes([episode(8, "timeout"), episode(8, evaluation="final")])
    assert [(row["episode_seed"], row["outcome"]) for row in run.read_episodes()] == [
        ("7", "collision"), ("8", "timeout"), ("9", "collision"), ("8", "collision"),
    ]  # fmt: skip


def test_a_run_is_evaluated_by_its_own_final_evaluation_alone(tmp_path):
    run = RunFolder(tmp_path)
    asked = [episode(i, frames="100", evaluation="evaluate", policy="sampled") for i in range(5)]
    run.log_episodes(asked)
    assert not run.is_evaluated(100, 2)
    run.log_episodes([episode(1, frames="100", evaluation="final")])
    assert not run.is_evaluated(100, 2)
    run.log_episodes([episode(2, frames="100", evaluation="final")])
    assert run.is_evaluated(100, 2)
    assert not run.is_evaluated(90, 2)


HEADER = ",".join(EVALUATION_COLUMNS)
ROW = ",".join(episode(1).values())
DAMAGED = {
    "semicolons": (f"{HEADER}\n{ROW}\n".replace(",", ";"), "lacks the columns"),
    "another column": (f"{HEADER},note\n{ROW},mine\n", "has unexpected ones: note"),
    "a column less": (f"{HEADER.replace(',hit', '')}\n", "lacks the columns hit"),
    "of before the column": (f"{HEADER.replace(',evaluation', '')}\n", "lacks.* evaluation"),
    "a short row": (f"{HEADER}\n{ROW}\n{ROW.rpartition(',')[0]}\n", "line 3: 13 cells"),
    "no number": (f"{HEADER}\n{ROW.replace('1', 'x', 1).replace(',1', ',x')}\n", "frames can't"),
    "no outcome": (f"{HEADER}\n{ROW.replace('collision', 'crash')}\n", "outcome can't be 'crash'"),
    "binary": ("\udcff\n", "no CSV table"),
}


@pytest.mark.parametrize(("text", "says"), DAMAGED.values(), ids=DAMAGED.keys())
def test_a_damaged_table_is_refused_and_stays_as_it_is(tmp_path, text, says):
    run = RunFolder(tmp_path)
    run.evaluation_path.write_text(text, errors="surrogateescape")
    before = run.evaluation_path.read_bytes()
    for touch in (run.read_episodes, lambda: run.log_episodes([episode(5)])):
        with pytest.raises(TableError, match=rf"evaluation\.csv.*{says}"):
            touch()
    with pytest.raises(TableError):
        run.forget_after(0)
    assert run.evaluation_path.read_bytes() == before


@pytest.mark.parametrize("text", ["\ufeff" + f"{HEADER}\n{ROW}\n", f"{HEADER}\n{ROW}\n{ROW[:9]}"])
def test_a_mark_at_its_beginning_and_half_a_line_at_its_end_are_no_damage(tmp_path, text):
    run = RunFolder(tmp_path)
    run.evaluation_path.write_text(text)
    run.log_episodes([episode(5)])
    assert run.read_episodes() == [episode(1), episode(5)]


def test_a_table_that_can_not_be_replaced_stays(tmp_path, monkeypatch):
    run = RunFolder(tmp_path)
    run.log_episodes([episode(1)])

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("flowrep.experiment.tables.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        run.log_episodes([episode(2)])
    assert run.read_episodes() == [episode(1)]
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["evaluation.csv"]
