"""One display of all runs, from what lies in their folders."""

import io
import json
import os
import platform

import pytest
from rich.console import Console

from flowrep.sweeps import sweep
from flowrep.sweeps.display import Display
from flowrep.sweeps.ending import Ending
from flowrep.sweeps.plan import Plan
from flowrep.sweeps.standing import Standing, standing_of
from flowrep.sweeps.sweep import sum_up


def running(folder, pid=None):
    """Leaves what a process that trains leaves."""
    folder.mkdir()
    holder = {"pid": pid or os.getpid(), "host": platform.node()}
    (folder / ".lock").write_text(json.dumps(holder))
    (folder / "config.yaml").write_text("seed: 0\ntotal_frames: 1000\n")
    rows = "frames,success,alpha\n100,nan,0.5\n200,0.25,0.4\n300,0.5"  # the last is being written
    (folder / "metrics.csv").write_text(rows)
    return folder


def test_a_run_stands_where_its_last_whole_row_says(tmp_path):
    assert standing_of(tmp_path / "none") == Standing("none", "waiting")
    run = running(tmp_path / "run")
    assert standing_of(run) == Standing("run", "running", 200, 1000, 0.25)
    (run / "metrics.csv").write_text("frames,success,alpha\n100,nan,0.5\n")
    assert standing_of(run) == Standing("run", "running", 100, 1000, None)
    Ending("failed", message="error: x").write(run)
    assert standing_of(run) == Standing("run", "failed", message="error: x")


def test_a_run_whose_files_were_damaged_is_running_as_far_as_is_known(tmp_path):
    run = running(tmp_path / "run")
    (run / "config.yaml").write_bytes(b"\xff\ntotal_frames: many\n")
    (run / "metrics.csv").write_bytes(b"frames,success,\xff\nfew,0.5,0\n")
    assert standing_of(run) == Standing("run", "running")


def test_a_run_whose_process_is_gone_waits(tmp_path):
    run = running(tmp_path / "run", pid=2**22 + 1)  # above the largest there can be
    assert standing_of(run).state == "waiting"
    (run / ".lock").write_text("")  # it was let go
    assert standing_of(run).state == "waiting"


STEPS = [
    [Standing("a", "finished", success=0.5), Standing("b", "waiting")],
    [Standing("a", "finished", success=0.5), Standing("b", "running", 50, 100, 0.25)],
    [Standing("a", "finished", success=0.5), Standing("b", "failed", message="error: [x]")],
]


@pytest.mark.parametrize("is_terminal", [False, True], ids=["file", "terminal"])
def test_what_happens_is_shown_once(is_terminal):
    out = io.StringIO()
    console = Console(file=out, width=100, force_terminal=is_terminal)
    at = iter([0, 1, 1, 2, 2, 2])
    display = Display(lambda: STEPS[next(at)], 2, console)
    with display:
        for _ in range(3):
            display.look()
            display._progress.refresh()
    if is_terminal:
        shown = out.getvalue()
        assert "success 25%" in shown
        assert "1 of 2 finished, 1 not" in shown
    else:
        assert out.getvalue().splitlines() == ["b: running", "b: failed: error: [x]"]


def test_the_summary_says_what_failed_where_its_log_is_and_how_to_go_on(tmp_path):
    out = io.StringIO()
    plan = Plan(tmp_path, 3, ("a", "b", "c"))
    standings = [*STEPS[2], Standing("c", "waiting")]
    sum_up(plan, standings, "python -m flowrep.train -m", Console(file=out, width=200))
    assert out.getvalue().splitlines() == [
        f"sweep: {tmp_path}",
        "1 of 3 runs finished",
        "1 failed:",
        "  b: failed: error: [x]",
        f"    log: {tmp_path}/b/job.log",
        "Continue the remaining runs with",
        "  python -m flowrep.train -m",
    ]


@pytest.mark.parametrize(
    ("problem", "is_printed"),
    [("No trials are completed yet.", False), ("the launcher is broken", True)],
)
def test_a_sweep_without_any_result_ends_in_its_summary(
    tmp_path, monkeypatch, capsys, problem, is_printed
):
    def fails():
        raise ValueError(problem)

    monkeypatch.setattr(sweep, "plan_of", lambda *_: Plan(tmp_path, 1, ("a",)))
    monkeypatch.setattr(sweep.hydra, "main", lambda **_: lambda job: fails)
    monkeypatch.setattr("sys.argv", ["flowrep-train", "-m"])
    with pytest.raises(SystemExit) as ended:
        sweep.run_sweep("train")
    assert ended.value.code == 1
    said = capsys.readouterr()
    assert "0 of 1 runs finished" in said.out
    assert ("Traceback" in said.err) is is_printed
