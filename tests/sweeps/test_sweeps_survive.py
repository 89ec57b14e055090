"""A sweep as a person runs it: interrupted, started again, with a run that fails."""

import csv
import json
import os
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("pybullet", reason="training drives the simulated street")
pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="the sweep runs two at a time")

from flowrep.sweeps.job import RUN
from tests.test_configs import composed

pytestmark = pytest.mark.slow

SWEEP = [
    sys.executable, "-m", "flowrep.train", "-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2",
    "debug=smoke", "representations=[obj]", "device=cpu", "num_envs=2", "algorithm.hidden_size=16",
    "total_frames=240", "checkpoint_every_frames=40", "log_every_frames=20",
    "evaluation.every_frames=0", "evaluation.final_episodes=1", "evaluation.speeds=[high]",
    "evaluation.baselines=[]", "evaluation.video=false", "scene.time_limit_steps=30",
]  # fmt: skip
# the second learning rate makes the weights too large for actions to have probabilities
RATES = "algorithm.learning_rate=3e-4,1e9"


def started(folder):
    return subprocess.Popen(
        [*SWEEP, RATES, f"hydra.sweep.dir={folder}"],
        stdout=(folder / "printed").open("w"),  # a pipe would be held open by its workers
        stderr=subprocess.STDOUT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )


def wait_for(find, seconds=180):
    deadline = time.monotonic() + seconds
    while not find() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert find()


def ctrl_c(sweep):
    """As a terminal does."""
    os.killpg(sweep.pid, signal.SIGINT)


def saved(folder):
    """When the checkpoint of the run that can succeed was written."""
    paths = folder.glob("*learning_rate-0.0003*/checkpoint/latest.safetensors")
    return [path.stat().st_mtime_ns for path in paths]


def frames_logged(folder):
    (table,) = folder.glob("*learning_rate-0.0003*/metrics.csv")
    with table.open(newline="") as file:
        return [int(row["frames"]) for row in csv.DictReader(file)]


def test_an_interrupted_sweep_goes_on_and_a_failed_run_stops_no_other(tmp_path):
    """Ctrl-C stops it after its first checkpoint, SIGKILL after one more; the third start ends."""
    before = []
    for end, code in ((ctrl_c, 130), (subprocess.Popen.kill, -signal.SIGKILL)):
        sweep = started(tmp_path)
        wait_for(lambda before=before: saved(tmp_path) not in ([], before))
        end(sweep)
        assert sweep.wait(timeout=180) == code
        before = saved(tmp_path)
    assert started(tmp_path).wait(timeout=300) == 1
    printed = (tmp_path / "printed").read_text()
    assert "1 of 2 runs finished" in printed
    assert "1 failed:" in printed
    (failed,) = tmp_path.glob("*learning_rate-1000000000.0*")
    assert f"log: {failed}/job.log" in printed
    assert "error: after " in (failed / "job.log").read_text()
    assert "error: after " in printed
    assert f"hydra.sweep.dir={tmp_path}" in printed
    assert frames_logged(tmp_path) == list(range(20, 241, 20))
    (whole,) = tmp_path.glob("*learning_rate-0.0003*")
    log = (whole / "job.log").read_text()
    assert log.count("run folder: ") == 3  # it was begun, and resumed twice


def test_a_run_saves_whatever_signals_its_scheduler_sends(tmp_path):
    """SLURM tells all processes of a job, not its first alone, and SIGTERM comes from two sides."""
    config = composed(*(text for text in SWEEP[6:] if "=" in text), "total_frames=100000")
    request = {"folder": str(tmp_path), "config": config, "machine": {}, "overrides": []}
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with subprocess.Popen(RUN, stdin=subprocess.PIPE, env=environment) as run:
        run.stdin.write(json.dumps(request).encode() + b"\n")
        run.stdin.flush()
        wait_for((tmp_path / "metrics.csv").is_file)
        for number in (signal.SIGUSR2, signal.SIGTERM, signal.SIGTERM):
            run.send_signal(number)
        assert run.wait(timeout=60) == 128 + signal.SIGTERM
    assert (tmp_path / "checkpoint" / "latest.safetensors").is_file()


def test_what_is_finished_is_not_run_again(tmp_path):
    line = [*SWEEP, "total_frames=40", "seed=0,1", f"hydra.sweep.dir={tmp_path}"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    for _ in range(2):
        done = subprocess.run(line, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        assert "2 of 2 runs finished" in done.stdout
    logs = [log.read_text() for log in tmp_path.glob("*/job.log")]
    assert [log.count("run folder: ") for log in logs] == [1, 1]
