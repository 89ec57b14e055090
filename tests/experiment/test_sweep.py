"""A sweep is runs: each is begun or resumed by its own command, and what it left says the rest."""

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from types import SimpleNamespace

import pytest
import yaml

from flowrep.config import CONF_DIR, cli, group_choices
from flowrep.config.schema import TrainConfig
from flowrep.experiment import sweep
from flowrep.experiment.outcomes import EVALUATION_COLUMNS, is_finished
from flowrep.files import TableError, read_rows
from flowrep.usage import UsageError
from tests.config.composing import composed, plain


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("-m seed=0,1", True),
        ("hydra.mode=MULTIRUN seed=0,1", True),
        ("seed=0", False),
        ("-m seed=0,1 --cfg job", False),
    ],
)
def test_several_runs_are_asked_for_in_hydras_ways(line, expected):
    assert sweep.is_sweep(line.split()) is expected


# One run, in whose place a piece of code ends in each possible way.

CONFIG = composed("debug=smoke", "evaluation.final_episodes=1", "evaluation.speeds=[low]")


@pytest.fixture
def attempt(tmp_path, monkeypatch):
    """Attempts a run that does what a piece of code says."""

    def attempt(code, should_stop=lambda: False):
        head = f"import os, signal, sys, time; folder = {str(tmp_path)!r}\n"
        # without site, which takes most of an interpreter's start
        monkeypatch.setattr(sweep, "TRAIN", (sys.executable, "-S", "-c", head + code))
        return sweep.attempted(tmp_path, CONFIG, ["given"], should_stop)

    monkeypatch.setattr(sweep, "POLL_S", 0.01)
    return attempt


# the final evaluation of `CONFIG`: one episode of each of four policies
FINISHES = f"""
open(folder + "/times", "a").write("x")
columns = {EVALUATION_COLUMNS}
with open(folder + "/evaluation.csv", "w") as table:
    print(*columns, sep=",", file=table)
    for policy, end in zip(("greedy", "sampled", "a", "b"), ("success", *["timeout"] * 3)):
        row = dict(evaluation="final", frames=256, policy=policy, fps=12.0, outcome=end)
        print(*(row.get(name, "") for name in columns), sep=",", file=table)
"""


def test_a_run_that_finishes_gives_its_success_and_is_not_run_again(attempt, tmp_path):
    for _ in range(2):
        assert attempt(FINISHES).startswith("finished, success 100%")
    assert (tmp_path / "times").read_text() == "x"
    assert is_finished(tmp_path, CONFIG)
    # made longer, it needs another final evaluation
    assert not is_finished(tmp_path, CONFIG.model_copy(update={"total_frames": 512}))


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("print('error: no such device', file=sys.stderr); sys.exit(2)", "error: no such device"),
        # after a progress bar, which ends its lines in another way
        ("print('\\revaluating: 0%|  \\r  \\rerror: no space'); sys.exit(2)", "error: no space"),
        # of a traceback, the last line; what to do about it is no reason
        ("print('error: it\\nContinue'); sys.exit(2)", "error: it"),
        ("raise ValueError('what happened')", "ValueError: what happened"),
        ("os.kill(os.getpid(), signal.SIGKILL)", "ended by SIGKILL.*memory"),
        ("", "exit code 0"),  # without its final evaluation
    ],
)
def test_a_run_that_fails_says_why_and_is_tried_again(attempt, tmp_path, code, expected):
    attempt("print('error: old'); sys.exit(2)")
    sweep.JobLog(tmp_path).begin("s1")
    state = attempt(code)
    assert re.match(f"failed: {expected}", state)
    assert sweep.JobLog(tmp_path).state("s1") == state
    assert sweep.JobLog(tmp_path).state("s2") is None  # of another sweep in the same folder
    assert attempt(FINISHES).startswith("finished")


SAVES = """
def save(*_):
    open(folder + "/saved", "w").close()
    sys.exit(143)
signal.signal(signal.SIGTERM, save)
open(folder + "/ready", "w").close()
time.sleep(60)
"""


@pytest.mark.parametrize("code", [129, 130, 143])
def test_a_run_that_saved_after_a_signal_is_stopped(attempt, code):
    assert attempt(f"sys.exit({code})") == "stopped"


def test_an_outcome_that_is_none_is_no_failure_and_no_success(attempt):
    with pytest.raises(TableError, match=r"evaluation\.csv.*'succes'"):
        attempt(FINISHES.replace('"success"', '"succes"'))


def test_a_run_is_told_to_save_when_the_sweep_is_stopped(attempt, tmp_path):
    assert attempt(SAVES, should_stop=(tmp_path / "ready").exists) == "stopped"
    assert (tmp_path / "saved").exists()


def test_no_run_begins_once_the_sweep_is_stopped(attempt, tmp_path):
    assert attempt(FINISHES, should_stop=lambda: True) == "stopped"
    assert not (tmp_path / "times").exists()


def test_a_run_saves_when_its_worker_is_ended_by_an_exception(attempt, tmp_path):
    def preempted():
        if (tmp_path / "ready").exists():
            raise SystemExit(-1)
        return False

    with pytest.raises(SystemExit):
        attempt(SAVES, should_stop=preempted)
    assert (tmp_path / "saved").exists()


def test_a_folder_with_another_run_is_not_taken_for_the_one_asked_for(attempt, tmp_path):
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(CONFIG.plain() | {"device": "cuda"}))
    assert attempt(FINISHES).startswith("finished")
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(CONFIG.plain() | {"seed": 9}))
    with pytest.raises(UsageError, match="seed=9"):
        attempt(FINISHES)


def test_a_run_has_resolved_what_its_sweep_leaves_to_the_machine(attempt, tmp_path, monkeypatch):
    algorithm = CONFIG.plain()["algorithm"]
    assert algorithm["precision"] == "auto"
    stored = CONFIG.plain() | {"algorithm": algorithm | {"precision": "bf16"}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(stored))
    assert attempt(FINISHES).startswith("finished")
    other = CONFIG.algorithm.model_copy(update={"precision": "fp32"})
    asked = CONFIG.model_copy(update={"algorithm": other})
    with pytest.raises(UsageError, match="precision"):
        sweep.attempted(tmp_path, asked, [], lambda: True)


def test_a_job_begins_its_run_or_resumes_it(monkeypatch, tmp_path):
    """In a folder with a name that Hydra and shells would misread, and a config of the user's."""
    odd, mine = tmp_path / "josé (2)", tmp_path / "mine"
    (mine / "scene").mkdir(parents=True)
    begun = "import json, sys; print('error: ' + json.dumps(sys.argv[1:])); sys.exit(2)"
    monkeypatch.setattr(sweep, "TRAIN", (sys.executable, "-S", "-c", begun))
    monkeypatch.setattr(sweep, "POLL_S", 0.01)
    typed = ["debug=smoke", "device=cpu", "seed=1", f"hydra.searchpath=[file://{mine}]"]
    typed += ["--config-dir", str(mine), f"hydra.sweep.dir='{odd}'"]

    def arguments():
        """What the one job of the sweep calls `flowrep.train` with."""
        monkeypatch.setattr(sys, "argv", ["train", "-m", *typed])
        with pytest.raises(SystemExit) as ended:
            sweep.run_sweep()
        assert ended.value.code == 1
        (log,) = odd.glob("*/job.log")
        (*_, reason) = [line for line in log.read_text().splitlines() if "error: " in line]
        return log.parent, json.loads(reason.rpartition("error: ")[2])

    folder, line = arguments()
    assert line[0] == f"hydra.run.dir='{folder}'"
    assert {"debug=smoke", "device=cpu", "seed=1", f"hydra.searchpath=[file://{mine}]"} <= {*line}
    assert line[line.index("--config-dir") + 1] == str(mine)
    (folder / "config.yaml").write_text(yaml.safe_dump(plain("train", *typed[:3])))
    assert arguments() == (folder, [f"resume='{folder}'", "device=cpu"])


def test_of_two_sweeps_in_a_folder_ctrl_c_stops_one_and_each_sums_up_its_own_runs(
    monkeypatch, tmp_path, capsys
):
    ids, both = {}, {}

    def run(name, meanwhile=lambda: None):
        """A sweep of one run, which asks whether it should stop after something happened."""

        def hydra(*_):
            ids[name] = next(x for x in sys.argv if "env_set" in x).rpartition("=")[2]
            folder = tmp_path / name
            folder.mkdir()
            job = SimpleNamespace(env_set={sweep.SWEEP_ID: ids[name]})
            dirs = {"output_dir": str(folder), "dir": str(tmp_path)}
            config = SimpleNamespace(
                runtime=SimpleNamespace(**dirs), sweep=SimpleNamespace(**dirs), job=job,
                sweeper={"_target_": "BasicSweeper"},
            )  # fmt: skip

            def attempted(folder, config, line, should_stop):
                meanwhile()
                both[name] = should_stop()
                return sweep.JobLog(folder).end(
                    sweep.STOPPED if both[name] else "finished, success 0%"
                )

            monkeypatch.setattr(sweep.HydraConfig, "get", lambda: config)
            monkeypatch.setattr(sweep, "attempted", attempted)
            sweep.job({})

        monkeypatch.setattr(sys, "argv", ["train", "-m", f"hydra.sweep.dir={tmp_path}", "seed=1,2"])
        monkeypatch.setattr(cli, "run_hydra", hydra)
        with pytest.raises(SystemExit) as ended:
            sweep.run_sweep()
        return ended.value.code

    monkeypatch.setattr(sweep, "arguments_of", lambda *_: [])
    monkeypatch.setattr(cli, "plain_config", lambda config: CONFIG.plain())
    codes = []

    def stop_the_other():
        codes.append(run("second", meanwhile=lambda: signal.raise_signal(signal.SIGINT)))
        capsys.readouterr()

    codes.append(run("first", meanwhile=stop_the_other))
    assert codes == [130, 0]
    assert both == {"first": False, "second": True}
    assert "1 of 1 runs finished" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == []  # no mark is left


@pytest.mark.parametrize("sweeper", ["x.BasicSweeper", "elsewhere.OptunaSweeper"])
def test_a_failed_run_stops_a_sweeper_that_needs_its_result_and_no_grid(
    monkeypatch, tmp_path, sweeper
):
    hydra = SimpleNamespace(
        runtime=SimpleNamespace(output_dir=str(tmp_path)),
        sweep=SimpleNamespace(dir=str(tmp_path)),
        job=SimpleNamespace(env_set={"FLOWREP_SWEEP": "s1"}),
        sweeper={"_target_": sweeper},
    )
    monkeypatch.setattr(sweep.HydraConfig, "get", lambda: hydra)
    monkeypatch.setattr(sweep, "arguments_of", lambda *_: [])
    monkeypatch.setattr(cli, "plain_config", lambda config: {})  # which is not valid
    if "Basic" in sweeper:
        assert math.isnan(sweep.job({}))
    else:
        with pytest.raises(sweep.RunFailedError, match="failed: error: seed"):
            sweep.job({})


def test_a_killed_worker_of_a_launcher_is_no_traceback(monkeypatch, tmp_path, capsys):
    def killed(config):
        raise BrokenProcessPool("A worker process was unexpectedly terminated")

    monkeypatch.setattr(sys, "argv", ["train", "-m", f"hydra.sweep.dir={tmp_path}"])
    with pytest.raises(SystemExit):
        cli.run_hydra("train", killed, TrainConfig)
    said = capsys.readouterr().err
    assert "error: A worker process" in said
    assert "Traceback" not in said


def test_a_sweep_of_one_run_to_continue_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["flowrep-train", "-m", "resume=outputs/a"])
    with pytest.raises(SystemExit) as ended:
        sweep.run_sweep()
    assert ended.value.code == 2
    assert "hydra.sweep.dir=" in capsys.readouterr().err


# The sweeps of conf/experiment/.


@pytest.mark.slow
def test_an_experiment_has_a_run_for_each_stack(monkeypatch, tmp_path):
    found = []

    def job(config):
        overrides = cli.HydraConfig.get().overrides.task
        found.append(dict(text.split("=", 1) for text in overrides))

    # typed, a scene and a seed replace the four and the three of the experiment
    line = ["experiment=flow_composition", "preset=laptop", "scene=s_turn", "seed=7"]
    monkeypatch.setattr(sys, "argv", ["train", "-m", f"hydra.sweep.dir={tmp_path}", *line])
    cli.run_hydra("train", job, TrainConfig)
    stacks = ["[ego]", "[raw]", "[obj]", "[ego,obj]"]
    assert sorted(run.pop("representations") for run in found) == sorted(stacks)
    typed = dict(text.split("=") for text in line)
    assert all(run == typed for run in found)


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", group_choices("experiment"))
def test_an_experiment_is_named_in_the_config_of_its_runs(name):
    config = plain("train", f"experiment={name}")
    assert config["experiment"] == name
    if name == "resolution":  # pictures stay square
        config = plain("train", f"experiment={name}", "scene.camera.height_px=48")
        assert config["scene"]["camera"]["width_px"] == 48
    if name == "frame_rate":  # evaluated at others than it was trained at
        assert config["scene"]["frame_rate_hz"] == 12
        assert config["evaluation"]["fps"] == [6, 7, 8, 9, 10, 12]


# A sweep as a person runs it.

LINE = [
    sys.executable, "-m", "flowrep.train", "-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2",
    "debug=smoke", "representations=[obj]", "device=cpu", "num_envs=2", "algorithm.hidden_size=16",
    "total_frames=240", "checkpoint_every_frames=40", "log_every_frames=20",
    "evaluation.every_frames=0", "evaluation.final_episodes=1", "evaluation.speeds=[high]",
    "evaluation.baselines=[]", "evaluation.video=false", "scene.time_limit_steps=30",
]  # fmt: skip
RATES = "algorithm.learning_rate=3e-4,-1"  # the second is refused before its run begins
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}


def started(folder):
    return subprocess.Popen(
        [*LINE, RATES, f"hydra.sweep.dir={folder}"],
        stdout=(folder / "printed").open("w"),  # a pipe would be held open by its workers
        stderr=subprocess.STDOUT,
        env=ENVIRONMENT,
        start_new_session=True,
    )


@pytest.mark.slow
def test_an_interrupted_sweep_goes_on_and_a_failed_run_stops_no_other(tmp_path):
    """Ctrl-C stops it after its first checkpoint; the second start ends it."""
    pytest.importorskip("pybullet", reason="training drives the simulated street")
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="it runs two at a time")
    process = started(tmp_path)
    checkpoint, deadline = "*rate-0.0003*/checkpoint/latest.safetensors", time.monotonic() + 180
    while not any(tmp_path.glob(checkpoint)) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    assert process.wait(timeout=180) == 130
    assert started(tmp_path).wait(timeout=300) == 1
    printed = (tmp_path / "printed").read_text()
    assert "1 of 2 runs finished, 1 failed" in printed
    (failed,) = tmp_path.glob("*learning_rate--1*")
    assert f"log: {failed}/job.log" in printed
    assert "error: algorithm.learning_rate" in (failed / "job.log").read_text()
    assert f"hydra.sweep.dir={tmp_path}" in printed
    (whole,) = tmp_path.glob("*learning_rate-0.0003*")
    rows = read_rows(whole / "metrics.csv")
    assert [int(row["frames"]) for row in rows] == list(range(20, 241, 20))
    assert (whole / "job.log").read_text().count("run folder: ") == 2  # begun, and resumed


def test_ray_can_join_a_cluster():
    # The plugin sets object_store_memory unless the key is there, and Ray refuses any value but
    # None when it joins a cluster.
    launcher = yaml.safe_load((CONF_DIR / "hydra/launcher/ray_jobs.yaml").read_text("utf-8"))
    assert launcher["ray"]["init"]["object_store_memory"] is None
