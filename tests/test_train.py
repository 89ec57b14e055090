"""The commands as a person runs them: in an empty folder, from start to table, or interrupted."""

import csv
import os
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("pybullet", reason="training drives the simulated street")

pytestmark = pytest.mark.slow

ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def smoke_run(tmp_path_factory):
    """One `debug=smoke` run in a folder of its own; gives the run folder and what was printed."""
    folder = tmp_path_factory.mktemp("empty")
    command = [sys.executable, "-m", "flowrep.train", "debug=smoke", "seed=3"]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=ENVIRONMENT)
    assert result.returncode == 0, result.stderr
    (run,) = folder.glob("outputs/*/*_straight_road_ego+obj_s3")
    return run, result


def test_a_run_leaves_a_folder_that_a_person_can_open(smoke_run):
    run, _ = smoke_run
    assert (run / "config.yaml").read_text().startswith("seed: 3")
    assert [row["frames"] for row in rows_of(run / "metrics.csv")] == ["64", "128", "192", "256"]
    assert list(run.glob("tensorboard/events.out.tfevents.*"))
    assert (run / "checkpoint" / "latest.safetensors").stat().st_size > 1e6
    assert (run / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    assert (run / "videos" / "episode_normal.mp4").stat().st_size > 1e4
    assert {path.name for path in run.iterdir() if not path.name.startswith(".")} == {
        "config.yaml", "metrics.csv", "tensorboard", "learning_curve.png", "checkpoint",
        "drives.npz", "evaluation.csv", "failures.csv", "machine.json", "videos",
    }  # fmt: skip


def test_a_run_is_evaluated_beside_baselines_at_every_speed(smoke_run):
    run, result = smoke_run
    final = [row for row in rows_of(run / "evaluation.csv") if row["frames"] == "256"]
    episodes = {(row["speed"], row["policy"]) for row in final}
    policies = ("greedy", "sampled", "never_turn", "random")
    assert episodes >= {(s, p) for s in ("low", "normal", "high") for p in policies}
    for word in (*policies, "low", "normal", "high", "out of bounds"):
        assert word in result.stdout


def test_a_run_says_what_it_is_where_it_runs_and_where_its_time_went(smoke_run):
    printed = smoke_run[1].stdout
    for word in (
        "DiscreteSAC",
        "[ego,obj]",
        "straight_road",
        "preset=paper",
        "device: ",
        "wall time: ",
    ):
        assert word in printed


def test_a_complete_run_is_not_evaluated_twice(smoke_run):
    run, _ = smoke_run
    tables = [run / "evaluation.csv", run / "failures.csv"]
    before = [table.read_text() for table in tables]
    tables[1].unlink()  # a full disk, say, left out what comes after the evaluation
    (run / "learning_curve.png").unlink()
    command = [sys.executable, "-m", "flowrep.train", f"resume={run}"]
    result = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT, cwd=run)
    assert result.returncode == 0, result.stderr
    assert "this run is complete" in result.stdout
    assert [table.read_text() for table in tables] == before
    assert (run / "learning_curve.png").read_bytes().startswith(b"\x89PNG")


def test_evaluate_adds_rows_for_what_was_asked(smoke_run):
    run, _ = smoke_run
    command = [
        sys.executable, "-m", "flowrep.evaluate", f"run={run}", "speed=high", "fps=[6,12]",
        "episodes=2", "num_envs=2", "num_workers=2", "policy=sampled", "baselines=[never_turn]",
        "seed=77",
    ]  # fmt: skip
    before = rows_of(run / "evaluation.csv")
    result = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT, cwd=run)
    assert result.returncode == 0, result.stderr
    added = rows_of(run / "evaluation.csv")[len(before) :]
    kinds = [(row["speed"], float(row["fps"]), row["policy"]) for row in added]
    assert sorted(set(kinds)) == [
        ("high", fps, policy) for fps in (6.0, 12.0) for policy in ("never_turn", "sampled")
    ]
    assert len(kinds) == 8


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_saves_and_says_how_to_go_on(number, code, tmp_path, short_folder):
    command = [
        sys.executable, "-m", "flowrep.train", "debug=smoke", "total_frames=1000000",
        "log_every_frames=16", "checkpoint_every_frames=1000000", "num_workers=2",
        f"hydra.run.dir={tmp_path}/run",
    ]  # fmt: skip
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=ENVIRONMENT | {"TMPDIR": str(short_folder)},
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "run" / "metrics.csv").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    os.killpg(process.pid, number)  # as terminals and schedulers do, the workers too
    printed, _ = process.communicate(timeout=120)
    assert process.returncode == code
    assert f"python -m flowrep.train resume={tmp_path}/run" in printed
    assert (tmp_path / "run" / "checkpoint" / "latest.safetensors").exists()
    assert not list(short_folder.glob("pymp-*"))  # what workers are told by
