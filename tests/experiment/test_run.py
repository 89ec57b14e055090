"""A run's folder: one owner, and tables that survive."""

import json
import multiprocessing
import time
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from flowrep.experiment.outcomes import COLUMNS, EpisodeRecord
from flowrep.experiment.provenance import machine_of
from flowrep.experiment.run import FolderInUseError, RunFolder, RunFolderError
from flowrep.files import TableError, write_rows
from tests.config.composing import composed


def hold(run, is_held):
    with run.locked():
        is_held.set()
        time.sleep(100)


def test_a_folder_has_one_process_and_one_that_was_killed_holds_it_no_more(tmp_path):
    run = RunFolder(tmp_path)
    fork = multiprocessing.get_context("fork")
    is_held = fork.Event()
    other = fork.Process(target=hold, args=(run, is_held), daemon=True)
    other.start()
    assert is_held.wait(timeout=60)
    with pytest.raises(FolderInUseError, match=str(tmp_path)), run.locked():
        pass
    other.kill()
    other.join()
    for _ in range(2):  # and it is given back
        with run.locked(), pytest.raises(FolderInUseError), RunFolder(tmp_path).locked():
            pass


def test_nothing_is_written_once_a_runs_folder_was_moved(tmp_path):
    run = RunFolder(tmp_path / "run")
    with run.locked():
        run.path.rename(tmp_path / "moved")
        for write in (lambda: run.log_machine({}), lambda: run.save_episodes([episode(2)])):
            with pytest.raises(OSError, match="run/"):
                write()
    assert not run.path.exists()


def test_metrics_and_means_of_evaluations_go_to_tensorboard(tmp_path):
    """Two of four succeed; returns 1, 2, 3 and 10, lengths 10, 20, 30 and 60."""
    run = RunFolder(tmp_path)
    run.log_metrics(10, {"alpha": 0.5})
    same = {"scene": "s_turn", "evaluation": "training", "policy": "greedy", "speed": "normal"}
    ends = [("success", 1, 10), ("timeout", 2, 20), ("collision", 3, 30), ("success", 10, 60)]
    run.log_episodes(
        [episode(1, end, return_=x, length=n, frames=500, **same) for end, x, n in ends]
    )
    run.flush()
    events = EventAccumulator(str(next(tmp_path.rglob("events.out.tfevents.*"))))
    events.Reload()
    title = "evaluation/s_turn/normal/12fps/greedy"
    plotted = {tag: events.Scalars(tag)[0] for tag in events.Tags()["scalars"]}
    assert {tag: (event.step, event.value) for tag, event in plotted.items()} == {
        "alpha": (10, 0.5),
        f"{title}/success": (500, 0.5),
        f"{title}/collision": (500, 0.25),
        f"{title}/out_of_bounds": (500, 0.0),
        f"{title}/timeout": (500, 0.25),
        f"{title}/return": (500, 4.0),
        f"{title}/length": (500, 30.0),
    }


def test_a_resumed_run_drops_the_rows_it_will_write_again(tmp_path):
    run = RunFolder(tmp_path)
    for frames in (10, 20, 30):
        run.log_metrics(frames, {"alpha": 1 / frames})
        run.log_episodes([episode(frames, frames=frames)])
    run.forget_after(20)
    run.metrics_path.write_bytes(run.metrics_path.read_bytes() + b"23,0.")  # killed as it wrote
    run.forget_after(20)
    run.log_metrics(25, {"alpha": 0.5})
    assert [row["frames"] for row in run.read_metrics()] == ["10", "20", "25"]
    assert [row["frames"] for row in run.read_episodes()] == ["10", "20"]


@pytest.mark.parametrize(("frames", "kind"), [(17, "training"), (8, "final"), (8, "evaluate")])
def test_only_what_was_written_before_the_first_checkpoint_is_dropped_without_one(
    tmp_path, frames, kind
):
    run = RunFolder(tmp_path)
    for logged in (8, 16):
        run.log_metrics(logged, {"alpha": 1 / logged})
        run.log_episodes([episode(1, frames=logged, evaluation="training")])
    run.start_again(first_save=16)
    assert not run.metrics_path.exists()
    assert not run.evaluation_path.exists()
    run.log_metrics(8, {"alpha": 0.5})
    run.log_episodes([episode(1, frames=frames, evaluation=kind)])
    with pytest.raises(RunFolderError, match=r"latest\.safetensors"):
        run.start_again(first_save=16)
    assert len(run.read_metrics()) == len(run.read_episodes()) == 1


def test_config_comes_back_as_written(tmp_path):
    run = RunFolder(tmp_path)
    config = composed("seed=3", "debug=smoke")
    run.write_config(config.plain())
    assert RunFolder.existing(tmp_path).config() == config
    run.write_total_frames(512)
    assert run.read_config() == config.plain() | {"total_frames": 512}


@pytest.mark.parametrize("text", ["", "- 1\n- 2\n", "seed: [1", "a: !!python/name:os.system"])
def test_a_damaged_config_is_named(tmp_path, text):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(RunFolderError, match=r"config\.yaml"):
        RunFolder.existing(tmp_path).read_config()


def test_a_run_notes_each_machine_with_its_first_start_and_its_last_end(tmp_path, monkeypatch):
    run, here = RunFolder(tmp_path), machine_of("bf16")
    assert here["precision"] == "bfloat16"
    assert here["cpu"]
    assert here["commit"] or here["flowrep"]
    another, noon = here | {"cpu": "another"}, datetime(2026, 1, 1, 12, tzinfo=UTC)
    for hours, machine in enumerate((here, here, another, here)):
        clock = SimpleNamespace(now=lambda _, hours=hours: noon + timedelta(hours=hours))
        monkeypatch.setattr("flowrep.experiment.run.datetime", clock)
        run.log_machine(machine)
    noted = json.loads((tmp_path / "machine.json").read_text())
    times = [[int(each.pop(key)[11:13]) for key in ("started", "ended")] for each in noted]
    assert noted == [here, another, here]
    assert times == [[12, 13], [14, 14], [15, 15]]


def test_a_folder_without_a_run_is_named(tmp_path):
    with pytest.raises(RunFolderError, match="holds no run"):
        RunFolder.existing(tmp_path / "nothing")
    run = RunFolder(tmp_path / "nothing")
    assert run.read_episodes() == run.read_metrics() == []
    assert not (tmp_path / "nothing").exists()


ROAD = np.array([[0.0, 0.0], [1.0, 2.0]], dtype=np.float32)


def episode(seed, outcome="collision", **changes):
    """The record of an episode that drove from (0, 0) to (1, 2)."""
    return EpisodeRecord(
        **{
            "speed": "low", "fps": 12.0, "episode_seed": seed, "path": "only", "outcome": outcome,
            "hit": "", "return_": 1.0, "length": 1, "frames": 1, "positions": ROAD,
        } | changes
    )  # fmt: skip


def cells(record, **changes):
    """A record as a row of evaluation.csv."""
    return {name: str(cell) for name, cell in record.row().items()} | changes


@pytest.mark.parametrize("name", ["config.yaml", "metrics.csv", "evaluation.csv"])
def test_a_new_run_is_refused_in_a_folder_that_holds_one(tmp_path, name):
    run = RunFolder(tmp_path)
    run.check_is_new()
    (tmp_path / name).write_text("something")
    resume = "resume=.*" if name == "config.yaml" else ""
    with pytest.raises(RunFolderError, match=rf"\({name}\).*{resume}hydra.run.dir="):
        run.check_is_new()


@pytest.mark.parametrize("there", [[], [2], [3, 4], [1, 2, 3, 4]])
def test_an_evaluation_run_again_leaves_the_table_of_one_that_was_never_stopped(tmp_path, there):
    run = RunFolder(tmp_path)
    run.save_episodes([episode(seed, evaluation="training") for seed in (3, 9)])
    run.save_episodes([episode(seed, "timeout", evaluation="final") for seed in there])
    run.save_episodes([episode(seed, evaluation="final") for seed in (1, 2, 3, 4)])
    assert [row["episode_seed"] for row in run.read_episodes()] == [*"391234"]
    assert {row["outcome"] for row in run.read_episodes()} == {"collision"}


HEADER = ",".join(COLUMNS)
ROW = ",".join(cells(episode(1)).values())
DAMAGED = {
    "no number": f"{HEADER}\n{','.join(cells(episode(1), frames='1O').values())}\n",
    "no outcome": f"{HEADER}\n{ROW.replace('collision', 'succesr')}\n",
    "semicolons": f"{HEADER}\n{ROW}\n".replace(",", ";"),
    "a column less": f"{HEADER.replace(',hit', '')}\n{ROW.rpartition(',')[0]}\n",
    "a short row": f"{HEADER}\n{ROW}\n{ROW.rpartition(',')[0]}\n",
}


@pytest.mark.parametrize("text", DAMAGED.values(), ids=DAMAGED.keys())
def test_a_damaged_table_is_refused_and_stays_as_it_is(tmp_path, text):
    run = RunFolder(tmp_path)
    run.evaluation_path.write_text(text)
    for touch in (lambda: run.log_episodes([episode(5)]), lambda: run.forget_after(0)):
        with pytest.raises(TableError, match=r"evaluation\.csv"):
            touch()
    assert run.evaluation_path.read_text() == text


def test_a_table_from_before_a_column_is_read_with_empty_cells_and_goes_on(tmp_path):
    run, older = RunFolder(tmp_path), cells(episode(1))
    del older["scene_id"], older["path"]
    write_rows(run.evaluation_path, [older])
    assert run.read_episodes() == [cells(episode(1), scene_id="", path="")]
    run.log_episodes([episode(2, path="left")])
    assert [row["path"] for row in run.read_episodes()] == ["", "left"]
