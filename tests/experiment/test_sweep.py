"""A sweep is runs: each is begun or resumed by its own command, and what it left says the rest."""

import os
import signal
import subprocess
import sys
import time

import pytest
import yaml
from omegaconf import OmegaConf

from flowrep import sweep
from flowrep.config import cli, group_choices
from flowrep.config.usage import UsageError
from flowrep.experiment.outcomes import COLUMNS, is_finished
from flowrep.files import open_to_append, read_rows, write_rows
from tests.config.composing import composed, plain, schema_of
from tests.running import ENVIRONMENT, run_here


def test_several_runs_are_asked_for_in_hydras_ways():
    lines = ("-m seed=0,1", "hydra.mode=MULTIRUN seed=0,1", "seed=0")
    assert [sweep.is_sweep(line.split()) for line in lines] == [True, True, False]


def test_runs_that_a_user_s_own_folders_keep_apart_may_differ_by_threads_alone():
    names, own = "${sweep_run_name:${hydra.overrides.task}}", "${hydra.job.num}"
    runs = {"sweeper": {"params": {}}, "overrides": {"task": ["seed=3", "threads=1,2"]}}
    sweep.check_folders_differ(OmegaConf.create(runs | {"sweep": {"subdir": own}}))
    with pytest.raises(UsageError, match=r"s3.*threads"):
        sweep.check_folders_differ(OmegaConf.create(runs | {"sweep": {"subdir": names}}))


# What is done of one run, whose final evaluation is one episode of each of four policies.

CONFIG = composed("debug=smoke", "evaluation.final_episodes=1", "evaluation.speeds=[low]")


def write_final_evaluation(folder, *ends):
    rows = [
        dict.fromkeys(COLUMNS, "")
        | {"evaluation": "final", "frames": 256, "policy": policy, "outcome": end}
        | {"fps": 12.0, "episode_seed": 1, "return": 1.0, "length": 9}
        for policy, end in zip(("greedy", "sampled", "a", "b"), ends)
    ]
    write_rows(folder / "evaluation.csv", rows)


@pytest.fixture
def attempt(tmp_path, monkeypatch):
    """Attempts the run; its process ends with a code after it has printed and done something."""

    def attempt(code=None, printed="", does=lambda: None, config=CONFIG, stop=False):
        def process(request, log, should_stop):
            assert code is not None, "no process should begin"
            log.write(printed.encode())
            does()
            return code

        monkeypatch.setattr(sweep, "_exit_code", process)
        with open_to_append(tmp_path / "job.log") as log:
            return sweep.attempted(tmp_path, config, log, lambda: stop)

    return attempt


def test_a_run_that_finishes_gives_its_success_and_is_not_run_again(attempt, tmp_path):
    ends = "success", *["timeout"] * 3
    state = attempt(0, does=lambda: write_final_evaluation(tmp_path, *ends))
    assert state == attempt() == "finished, success 100%"
    # made longer, it needs another final evaluation
    assert not is_finished(tmp_path, CONFIG.model_copy(update={"total_frames": 512}))


@pytest.mark.parametrize(
    ("code", "printed", "expected"),
    [
        (2, "error: no such device", "failed: error: no such device"),
        # after a progress bar, which ends its lines in another way
        (2, "\revaluating: 0%|  \r  \rerror: no space", "failed: error: no space"),
        (2, "error: it\nContinue", "failed: error: it"),  # what to do about it is no reason
        (1, "Traceback\nValueError: what happened", "failed: ValueError: what happened"),
        (-signal.SIGKILL, "", "failed: ended by SIGKILL: is there enough memory?"),
        (0, "", "failed: exit code 0"),  # without its final evaluation
        (128 + signal.SIGHUP, "saved", "stopped"),
        (128 + signal.SIGUSR1, "saved", "stopped"),
        (-signal.SIGTERM, "", "stopped"),
    ],
)
def test_a_run_that_ends_early_says_why(attempt, code, printed, expected):
    attempt(2, "error: old\n")
    assert attempt(code, printed) == expected


def test_no_run_begins_once_the_sweep_is_stopped(attempt):
    assert attempt(stop=True) == "stopped"


def test_a_folder_with_another_run_is_not_taken_for_the_one_asked_for(attempt, tmp_path):
    write_final_evaluation(tmp_path, *["success"] * 4)
    stored = CONFIG.plain() | {"device": "cuda"}
    stored["algorithm"]["precision"] = "bf16"  # which the run has resolved
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(stored))
    assert attempt().startswith("finished")
    fp32 = CONFIG.algorithm.model_copy(update={"precision": "fp32"})
    for other in ({"seed": 9}, {"algorithm": fp32}):
        with pytest.raises(UsageError, match=f"{min(other)}="):
            attempt(config=CONFIG.model_copy(update=other))


def test_the_last_line_of_a_log_says_how_its_run_ended(tmp_path):
    log, begun = tmp_path / "job.log", "--- begun 2026-01-31 12:00:00\n"
    for end, state in (
        (begun, "stopped"),
        (f"{begun}run folder: x\n", "stopped"),
        ("saved\n--- failed: error: no space\n", "failed: error: no space"),
    ):
        log.write_text(f"--- finished, success 3%\n{end}")
        assert sweep.state_of(log) == state


@pytest.mark.parametrize(
    ("plus", "typed", "run"),
    [("", "{}", "a"), ("++", "{}", "a"), ("", "{}", "a/b"), ("", "~", "a")],
)
def test_a_sweep_finds_its_failed_runs_in_the_folder_that_was_typed(
    monkeypatch, tmp_path, plus, typed, run
):
    def fail(*_):
        (tmp_path / run).mkdir(parents=True)
        (tmp_path / run / sweep.LOG).write_text("--- failed: error: no space\n")

    monkeypatch.setattr(cli, "run_hydra", fail)
    monkeypatch.setenv("HOME", str(tmp_path))
    given = f"{plus}hydra.sweep.dir={typed.format(tmp_path)}"
    assert run_here(monkeypatch, ["python", "-m", "flowrep.train", "--multirun", given]) == 1


@pytest.mark.parametrize("key", ["resume", "++resume", "hydra.run.dir"])
def test_a_folder_of_one_run_is_refused_for_a_sweep(monkeypatch, capsys, key):
    monkeypatch.setattr(cli, "run_hydra", lambda *_: None)
    line = ["python", "-m", "flowrep.train", "--multirun", f"{key}=outputs/a"]
    assert run_here(monkeypatch, line) == 2
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
    cli.run_hydra("train", job, schema_of("train"))
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
    "python", "-m", "flowrep.train", "--multirun", "debug=smoke", "representations=[obj]",
    "device=cpu", "num_envs=2", "algorithm.hidden_size=16", "total_frames=240",
    "checkpoint_every_frames=40", "log_every_frames=20", "evaluation.every_frames=0",
    "evaluation.final_episodes=1", "evaluation.speeds=[high]", "evaluation.baselines=[]",
    "evaluation.video=false", "scene.time_limit_steps=30",
    "algorithm.learning_rate=-1,3e-4",  # the first is refused before its run begins
]  # fmt: skip
TWO_AT_A_TIME = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]


@pytest.mark.slow
def test_an_interrupted_sweep_goes_on_and_a_failed_run_stops_no_other(
    tmp_path, monkeypatch, capsys
):
    """Ctrl-C stops it after its first checkpoint; the second start ends it, with one job a time."""
    pytest.importorskip("pybullet", reason="training drives the simulated street")
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="it runs two at a time")
    where = f"hydra.sweep.dir={tmp_path}"
    with (tmp_path / "printed").open("w") as printed:  # a pipe would be held open by its workers
        process = subprocess.Popen(
            [sys.executable, *LINE[1:], *TWO_AT_A_TIME, where],
            stdout=printed, stderr=subprocess.STDOUT, env=ENVIRONMENT, start_new_session=True,
        )  # fmt: skip
    checkpoint, deadline = "*rate-0.0003*/checkpoint/latest.safetensors", time.monotonic() + 180
    while not any(tmp_path.glob(checkpoint)) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    assert process.wait(timeout=180) == 130
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert run_here(monkeypatch, [*LINE, where]) == 1
    printed = capsys.readouterr().out
    assert "1 of 2 runs finished" in printed
    (failed,) = tmp_path.glob("*learning_rate--1*")
    assert f"log: {failed}/job.log" in printed
    assert "error: algorithm.learning_rate" in (failed / "job.log").read_text()
    assert where in printed
    (whole,) = tmp_path.glob("*learning_rate-0.0003*")
    rows = read_rows(whole / "metrics.csv")
    assert [int(row["frames"]) for row in rows] == list(range(20, 241, 20))
    assert (whole / "job.log").read_text().count("run folder: ") == 2  # begun, and resumed
