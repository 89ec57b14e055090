"""What a launcher's worker does about one run: a stand-in for the run ends in each possible way."""

import json
import math
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest
import yaml

from flowrep.sweeps import job
from flowrep.sweeps.ending import Ending
from flowrep.sweeps.stopping import SweepStop, is_stopped

CONFIG = {"seed": 1, "scene": {"name": "s_turn"}, "device": "auto", "resume": None}


@pytest.fixture
def request_for(tmp_path, monkeypatch):
    """Gives a request to a run that does what a piece of code says."""

    def make(code, config=CONFIG):
        head = "import json, os, signal, sys, time; r = json.loads(sys.stdin.readline())\n"
        monkeypatch.setattr(job, "RUN", (sys.executable, "-c", head + code))
        return {"folder": str(tmp_path), "config": config, "machine": {}, "overrides": []}

    monkeypatch.setattr(job, "POLL_S", 0.01)
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # pytest's own Ctrl-C stays
    return make


def never():
    return False


FINISHES = """
from pathlib import Path
open(r["folder"] + "/times", "a").write("x")
Path(r["folder"], "config.yaml").write_text(json.dumps(r["config"]))
Path(r["folder"], "ending.json").write_text('{"how": "finished", "success": 0.75}')
"""


def times_run(folder):
    return len((folder / "times").read_text())


def test_a_run_that_finishes_gives_its_success_and_is_not_run_again(request_for, tmp_path):
    request = request_for(FINISHES)
    assert job.supervised(request, never) == Ending("finished", 0.75)
    assert job.supervised(request, never) == Ending("finished", 0.75)
    assert times_run(tmp_path) == 1


def test_a_run_of_another_config_is_not_taken_for_the_one_asked_for(request_for, tmp_path):
    job.supervised(request_for(FINISHES), never)
    moved = CONFIG | {"device": "cpu"}  # where it is computed makes no difference
    job.supervised(request_for(FINISHES, moved), never)
    assert times_run(tmp_path) == 1
    job.supervised(request_for(FINISHES, CONFIG | {"scene": {"name": "mine"}}), never)
    assert times_run(tmp_path) == 2


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("print('error: no such device', file=sys.stderr); sys.exit(2)", "error: no such device"),
        # after a progress bar, which ends its lines in another way
        ("print('\\revaluating: 0%|  \\r  \\rerror: no space'); sys.exit(2)", "error: no space"),
        # of a traceback, the last line; what to do about it is no reason
        (
            "print('error: failed:\\nerror: OSError: it\\nContinue'); sys.exit(2)",
            "error: OSError: it",
        ),
        ("raise ValueError('what happened')", "ValueError: what happened"),
        ("sys.exit(3)", "exit code 3"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "ended by SIGKILL: is there enough memory?"),
        ("os.kill(os.getpid(), signal.SIGSEGV)", "ended by SIGSEGV"),
    ],
)
def test_a_run_that_fails_says_why_and_is_tried_again(request_for, tmp_path, code, expected):
    ending = job.supervised(request_for(code), never)
    assert ending.how == "failed"
    assert ending.message == expected
    assert Ending.read(tmp_path) == ending
    assert job.supervised(request_for(FINISHES), never).how == "finished"


@pytest.mark.parametrize(
    "damage", [b"\xff", b"- 1\n", b"seed: 2001-99-99\n", b"seed: 2001-01-01\n"]
)
def test_a_finished_run_whose_config_was_damaged_is_not_taken_for_finished(
    request_for, tmp_path, damage
):
    job.supervised(request_for(FINISHES), never)
    (tmp_path / "config.yaml").write_bytes(damage)
    ending = job.supervised(request_for("print('error: config.yaml'); sys.exit(2)"), never)
    assert ending == Ending.read(tmp_path) == Ending("failed", message="error: config.yaml")


def test_a_run_that_can_not_be_started_has_failed(request_for, tmp_path):
    (tmp_path / "job.log").mkdir()
    ending = job.supervised(request_for(FINISHES), never)
    assert ending == Ending.read(tmp_path)
    assert ending.how == "failed"
    assert ending.message.endswith(f"Is a directory: '{tmp_path}/job.log'")


def test_a_reason_that_can_not_be_written_is_remembered(request_for, tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Ending, "write", full)
    ending = job.supervised(request_for("print('error: why'); sys.exit(1)"), never)
    assert ending == Ending.read(tmp_path) == Ending("failed", message="error: why")
    assert f"{tmp_path}: failed: error: why (not saved: [Errno 28]" in capsys.readouterr().err
    Ending.forget(tmp_path)
    assert Ending.read(tmp_path) is None


def test_what_an_earlier_attempt_said_is_not_the_reason_of_the_next(request_for):
    job.supervised(request_for("print('error: old'); sys.exit(2)"), never)
    assert job.supervised(request_for("sys.exit(1)"), never).message == "exit code 1"


def test_the_log_has_what_each_attempt_printed(request_for, tmp_path):
    for word in ("first", "second"):
        job.supervised(request_for(f"print('{word}'); sys.exit(1)"), never)
    lines = (tmp_path / "job.log").read_text().splitlines()
    assert [line for line in lines if not line.startswith("---")] == ["first", "second"]
    assert len(lines) == 4


SAVES = """
def save(*_):
    open(r["folder"] + "/saved", "w").close()
    sys.exit(143)
signal.signal(signal.SIGTERM, save)
open(r["folder"] + "/ready", "w").close()
time.sleep(60)
"""


def test_a_run_is_told_to_save_when_the_sweep_is_stopped(request_for, tmp_path):
    ending = job.supervised(request_for(SAVES), (tmp_path / "ready").exists)
    assert (tmp_path / "saved").exists()
    assert ending == Ending("stopped")


def test_no_run_begins_once_the_sweep_is_stopped(request_for, tmp_path):
    assert job.supervised(request_for(FINISHES), lambda: True) == Ending("stopped")
    assert not (tmp_path / "times").exists()


def test_a_run_saves_when_its_worker_is_ended_by_an_exception(request_for, tmp_path):
    def preempted():
        if (tmp_path / "ready").exists():
            raise SystemExit(-1)
        return False

    with pytest.raises(SystemExit):
        job.supervised(request_for(SAVES), preempted)
    assert (tmp_path / "saved").exists()


def test_a_request_that_is_not_read_is_no_mystery(request_for, monkeypatch):
    request = request_for("")
    monkeypatch.setattr(job, "RUN", (sys.executable, "-c", "raise ImportError('no torch')"))
    request["overrides"] = ["x" * 1_000_000]  # more than a pipe holds
    assert job.supervised(request, never).message == "ImportError: no torch"


def test_a_failed_run_stops_a_sweeper_that_needs_its_result_and_no_grid(monkeypatch, tmp_path):
    def hydra_with(sweeper):
        return SimpleNamespace(
            runtime=SimpleNamespace(output_dir=str(tmp_path)),
            overrides=SimpleNamespace(task=[]),
            sweep=SimpleNamespace(dir=str(tmp_path)),
            sweeper={"_target_": sweeper},
        )

    monkeypatch.setattr(job, "plain_config", lambda config: {"device": "cpu", "num_workers": 0})
    monkeypatch.setattr(job, "supervised", lambda *_: Ending("failed", message="why"))
    grid = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"
    monkeypatch.setattr(job.HydraConfig, "get", lambda: hydra_with(grid))
    assert math.isnan(job.job({}))
    monkeypatch.setattr(job.HydraConfig, "get", lambda: hydra_with("elsewhere.OptunaSweeper"))
    with pytest.raises(job.RunFailedError, match="failed: why"):
        job.job({})


def test_a_process_is_asked_to_stop_when_who_started_it_is_gone(tmp_path):
    code = (
        "import signal, time; from flowrep.sweeps.stopping import stop_when_closed\n"
        "signal.signal(signal.SIGTERM, lambda *_: exit(7)); stop_when_closed(0)\n"
        "print('ready', flush=True); time.sleep(60)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout.readline() == b"ready\n"
    process.stdin.close()
    assert process.wait(timeout=30) == 7
    process.stdout.close()


def test_the_definition_of_a_run_leaves_out_where_it_is_computed():
    stored = yaml.safe_load(yaml.safe_dump(CONFIG | {"num_workers": 2, "trust": "a.B"}))
    assert job.definition(stored) == {"seed": 1, "scene": {"name": "s_turn"}}
    assert json.loads(json.dumps(job.definition(CONFIG))) == job.definition(stored)


def test_the_first_signal_marks_the_sweep_until_it_has_ended(tmp_path):
    with SweepStop(tmp_path) as stop:
        assert not is_stopped(tmp_path)
        signal.raise_signal(signal.SIGINT)
        assert is_stopped(tmp_path)
        assert stop.received == signal.SIGINT
    assert not is_stopped(tmp_path)  # all jobs have ended


def test_the_second_signal_ends_the_process_and_jobs_still_queued_find_the_mark(tmp_path):
    def press_twice():
        with SweepStop(tmp_path):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        press_twice()
    assert is_stopped(tmp_path)
    with SweepStop(tmp_path):  # the sweep is continued
        assert not is_stopped(tmp_path)
