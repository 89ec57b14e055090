"""The commands as a person runs them: in an empty folder, from start to table, or interrupted."""

import io
import os
import signal
import subprocess
import sys
import time
from contextlib import redirect_stdout
from itertools import product

import pytest
import yaml

pytest.importorskip("pybullet", reason="training drives the simulated street")

from flowrep.files import read_rows
from tests.running import ENVIRONMENT, run_here, run_python

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def smoke_run(tmp_path_factory):
    """One `debug=smoke` run in a folder of its own; gives the run folder and what was printed."""
    folder, printed = tmp_path_factory.mktemp("empty"), io.StringIO()
    line = "-m flowrep.train debug=smoke seed=3 scene.time_limit_steps=60"
    line += " evaluation.final_episodes=2 evaluation.episodes=1"
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        patch.chdir(folder)
        assert run_here(patch, ["python", *line.split()]) == 0
    (run,) = folder.glob("outputs/*/*_straight_road_ego+obj_s3")
    return run, printed.getvalue()


MAPS, TO = "scene=s_turn representations=[ego]", "output=out"
REFUSED = {
    "train": ["total_frames=abc", "resume=nothing"],
    "evaluate": ["episodes=0", "run=nothing", f"policy=nothing.py:make {MAPS}"],
    "factorize": [f"input=x {TO} format=frames video_fps=0", f"input=nothing {TO} format=tum"],
    "report": ["x policy=fast", "nothing"],
    "view": ["speed=fast", "policy=nothing.py:make", "policy=pilot"],
}
RUN_EACH_LINE = """
import runpy, sys
for line in sys.argv[1:]:
    name, *arguments = line.split()
    sys.argv = [name, *arguments]
    code = 0
    try:
        runpy.run_module(f"flowrep.{name}", run_name="__main__", alter_sys=True)
    except SystemExit as ended:
        code = ended.code
    late = {"torch", "matplotlib", "pybullet", "cv2", "scipy.stats"} & {*sys.modules}
    print("", f"{name} ended with {code}, imported {late or None}", sep="\\n")
"""


def test_help_and_refusals_need_no_pytorch_and_no_folder(tmp_path):
    lines = {f"{name} {line}": 2 for name in REFUSED for line in REFUSED[name]}
    lines |= {f"{name} --help": 0 for name in REFUSED}
    printed = run_python("-c", RUN_EACH_LINE, *lines, cwd=tmp_path, check=True).stdout
    said = [line for line in printed.splitlines() if " ended with " in line]
    assert said == [
        f"{line.split()[0]} ended with {code}, imported None" for line, code in lines.items()
    ]
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    "missing",
    ["device=cuda:93", "algorithm._target_=sys.path", "+representations.x._target_=sys.path"],
)
def test_a_device_or_class_that_is_not_there_leaves_no_folder(
    tmp_path, monkeypatch, capsys, missing
):
    monkeypatch.chdir(tmp_path)
    assert run_here(monkeypatch, ["python", "-m", "flowrep.train", missing]) == 2
    assert missing.lstrip("+") in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


def test_a_run_leaves_a_folder_with_episodes_of_agent_and_baselines_at_every_speed(smoke_run):
    run, _ = smoke_run
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert config["seed"] == 3
    assert config["threads"] == 1
    assert config["algorithm"]["precision"] in ("bf16", "fp32")  # as measured, not auto
    assert [row["frames"] for row in read_rows(run / "metrics.csv")] == ["64", "128", "192", "256"]
    final = [row for row in read_rows(run / "evaluation.csv") if row["frames"] == "256"]
    drivers = product(("low", "normal", "high"), ("greedy", "never_turn", "random"))
    assert {(row["speed"], row["policy"]) for row in final} >= {*drivers}
    assert list(run.glob("tensorboard/events.out.tfevents.*"))
    assert (run / "checkpoint" / "latest.safetensors").stat().st_size > 1e6
    assert (run / "videos" / "episode_normal.mp4").stat().st_size > 1e4
    assert {path.name for path in run.iterdir() if not path.name.startswith(".")} == {
        "config.yaml", "metrics.csv", "tensorboard", "checkpoint",
        "evaluation.csv", "machine.json", "videos",
    }  # fmt: skip


def test_a_run_says_what_it_is_where_it_runs_and_how_it_went(smoke_run):
    what = ["DiscreteSAC", "[ego,obj]", "straight_road", "debug=smoke", "device: "]
    what += ["evaluation.final_episodes=2"]
    how = ["greedy", "never_turn", "normal", "out of bounds", "wall time: "]
    assert [word for word in what + how if word not in smoke_run[1]] == []


def test_a_complete_run_is_not_evaluated_twice(smoke_run, monkeypatch, capsys):
    run, _ = smoke_run
    before = (run / "evaluation.csv").read_text()
    film = run / "videos" / "episode_normal.mp4"
    film.unlink()
    assert run_here(monkeypatch, ["python", "-m", "flowrep.train", f"resume={run}"]) == 0
    assert "this run is complete" in capsys.readouterr().out
    assert film.stat().st_size > 1e4
    assert (run / "evaluation.csv").read_text() == before


def test_an_interrupted_run_saves_and_says_how_to_go_on(tmp_path, short_folder):
    """By Ctrl-C in a terminal; tests/test_progress.py has the other signals."""
    line = [
        sys.executable, "-m", "flowrep.train", "debug=smoke", "total_frames=1000000",
        "log_every_frames=16", "checkpoint_every_frames=1000000", "num_workers=1",
        f"hydra.run.dir={tmp_path}/run",
    ]  # fmt: skip
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = ENVIRONMENT | {"TMPDIR": str(short_folder)}
    process = subprocess.Popen(line, env=environment, start_new_session=True, **pipes)
    deadline = time.monotonic() + 120
    while not (tmp_path / "run" / "metrics.csv").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)  # as terminals do, its worker too
    printed, errors = process.communicate(timeout=120)
    assert process.returncode == 128 + signal.SIGINT
    assert "Traceback" not in errors
    assert f"python -m flowrep.train resume={tmp_path}/run" in printed
    assert (tmp_path / "run" / "checkpoint" / "latest.safetensors").exists()
    assert not list(short_folder.glob("pymp-*"))  # what a worker is told by
