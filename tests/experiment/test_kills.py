"""A run that is killed at any instant goes on, and ends as one that never was."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import pytest

from flowrep.agent import load_checkpoint
from flowrep.experiment.run import RunFolder
from tests.comparing import differing
from tests.config.composing import plain
from tests.experiment.test_runner import CLOCK, without_clock
from tests.running import ENVIRONMENT, glossary

pytestmark = pytest.mark.slow

STAGES = {"dsac": ("renamed", "write", "half"), "ppo": ("flush", "rename")}
"""Of writing a checkpoint; with a replay memory and without."""
SMALL = [
    "debug=smoke", "num_envs=1", "algorithm.precision=fp32", "algorithm.hidden_size=16",
    "total_frames=48", "checkpoint_every_frames=8", "log_every_frames=4", "device=cpu",
    "evaluation.every_frames=0", "evaluation.final_episodes=1", "evaluation.speeds=[high]",
    "evaluation.baselines=[]", "evaluation.video=false", "scene.time_limit_steps=30",
]  # fmt: skip


def new_run(path, algorithm="dsac"):
    """A run folder in which nothing was done yet."""
    often = "rollout_length=16" if algorithm == "ppo" else "frames_per_update=4"
    config = plain("train", *SMALL, f"algorithm={algorithm}", f"algorithm.{often}")
    run = RunFolder(path)
    run.write_config(config)
    return run


@pytest.fixture(scope="module")
def server():
    """A process that forks others; not Python's forkserver, which has what workers import."""
    command = [sys.executable, "-m", "tests.experiment.forked_train"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=ENVIRONMENT, **pipes) as server:
        yield server


@pytest.fixture
def carry_on(tmp_path, server):
    """Continues a run in a process of its own; returns its exit code and what it printed."""

    def carry_on(run, kill_after_s=None, **how):
        printed = tmp_path / f"printed_{time.monotonic_ns()}"
        line = json.dumps({"run": str(run.path), "printed": str(printed), **how})
        print(line, file=server.stdin, flush=True)
        child = int(server.stdout.readline())
        if kill_after_s is not None:
            time.sleep(kill_after_s)
            with suppress(ProcessLookupError):  # it has ended
                os.kill(child, signal.SIGKILL)
        return int(server.stdout.readline()), printed.read_text() if printed.exists() else ""

    return carry_on


@pytest.mark.parametrize("algorithm", STAGES)
def test_a_run_killed_again_and_again_ends_bit_for_bit_as_one_that_was_not(
    tmp_path, carry_on, algorithm
):
    whole, run = new_run(tmp_path / "whole", algorithm), new_run(tmp_path / "killed", algorithm)
    start = time.monotonic()
    assert carry_on(whole)[0] == 0
    duration = time.monotonic() - start
    carry_on(run, kill_after_s=duration / 3)
    reached = []
    for stage in STAGES[algorithm]:
        code, printed = carry_on(run, kill_at=[stage, 2])  # the session's second checkpoint
        assert code in (0, -signal.SIGKILL), printed
        reached.append(load_checkpoint(run.checkpoint_path)["frames"])
    assert reached == sorted(reached)
    assert carry_on(run)[0] == 0
    expected = load_checkpoint(whole.checkpoint_path)
    assert differing(expected, load_checkpoint(run.checkpoint_path)) == []
    rows = without_clock(run.read_metrics())
    assert rows == without_clock(whole.read_metrics())
    assert [int(row["frames"]) for row in rows] == list(range(4, 49, 4))
    assert all(any(row[name] != "nan" for row in rows) for name in rows[0])
    assert {*rows[0], *CLOCK} <= glossary()
    assert run.read_episodes() == whole.read_episodes()


def test_a_full_disk_ends_in_one_line_and_leaves_the_last_checkpoint(tmp_path, carry_on):
    run = new_run(tmp_path)
    assert carry_on(run, kill_at=["flush", 4])[0] == -signal.SIGKILL
    before = load_checkpoint(run.checkpoint_path)
    code, printed = carry_on(run, largest_file=200_000)
    assert code == 2
    (line,) = [line for line in printed.splitlines() if "error" in line.lower()]
    assert line.startswith("error: after ")
    assert "File too large" in line
    assert f"resume={run.path}" in printed
    assert "Traceback" not in printed
    assert differing(before, load_checkpoint(run.checkpoint_path)) == []
    assert carry_on(run)[0] == 0
