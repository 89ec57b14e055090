"""Sweeps: `python -m flowrep.train -m seed=0,1,2` trains a run for each job, each in a folder.

A job starts `python -m flowrep.train <its overrides> hydra.run.dir=<folder>`. If that run has begun
already, the job resumes it, and if its final evaluation is done, there is nothing to do. So the
same command continues a sweep, whatever stopped it. Hydra's launchers (one run after the other,
joblib, SLURM, Ray) call `job` in their workers, so this module imports no PyTorch.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import re
import secrets
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import NoReturn

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from flowrep.config import cli
from flowrep.config.schema import TrainConfig, validated, validated_run
from flowrep.experiment.outcomes import is_finished, success_of
from flowrep.files import open_to_append
from flowrep.options import ALGORITHMS
from flowrep.progress import STOP_SIGNALS, StopRequest
from flowrep.usage import UsageError
from flowrep.yaml_file import read_yaml

cli.register_resolvers()  # for the paths in conf/run_folder.yaml, which a worker resolves too

LOG = "job.log"
STOP = ".stop_"
"""Prefix of the name of a file that makes a sweep's jobs, on any machine, save and stop.

The sweep's id follows, as two sweeps may share a folder. Jobs get the id as `SWEEP_ID` in
`hydra.job.env_set`.
"""
SWEEP_ID = "FLOWREP_SWEEP"
_BEGUN = "--- sweep "
POLL_S = 0.5
PARENT = os.getppid()
TRAIN = (sys.executable, "-m", "flowrep.train")
FINISHED, FAILED, STOPPED = "finished", "failed", "stopped"
_ONLY_SHOWS = {"--cfg", "-c", "--info", "-i", "--help", "-h", "--hydra-help", "--version"}
_NEEDED_BY = {
    # Finished jobs take no time, so batches would grow and delay the unfinished ones.
    "hydra/launcher=joblib": ("hydra.launcher.batch_size=1",),
    # A run returns its success, and a failed run should not end the study.
    "hydra/sweeper=optuna": (
        "hydra.sweeper.direction=maximize",
        "hydra.sweeper.max_failure_rate=1.0",
    ),
}
"""Options that a sweep with these plugins needs; they are added unless they are typed."""


class RunFailedError(RuntimeError):
    """A run of a sweep has no result."""


def is_sweep(arguments: list[str]) -> bool:
    """Returns whether a command line starts several runs, rather than only showing their config."""
    given = {"-m", "--multirun", "hydra.mode=MULTIRUN"} & {*arguments}
    return bool(given) and not _ONLY_SHOWS & {*arguments}


def run_sweep() -> NoReturn:
    """Runs the sweep of `sys.argv`, prints how it ended, and ends the process."""
    keys = {text.partition("=")[0] for text in sys.argv[1:]}
    if "resume" in keys:
        cli.exit_with(
            "resume= continues one run; to continue a sweep, repeat its command with "
            "hydra.sweep.dir=<its folder>"
        )
    typed = [text for text in sys.argv[1:] if not text.startswith("hydra.sweep.dir=")]
    folders = [cli.value_of(text) for text in sys.argv[1:] if text not in typed]
    new = f"outputs/{datetime.now():%Y-%m-%d/%H-%M-%S}_sweep"
    folder = Path(folders[-1] if folders else new).absolute()
    sweep_id = f"s{secrets.token_hex(4)}"  # not digits alone, which Hydra reads as a number
    given = cli.override("hydra.sweep.dir", str(folder))
    needed = [option for choice in typed for option in _NEEDED_BY.get(choice, ())]
    needed = [option for option in needed if option.partition("=")[0] not in keys]
    # argparse needs all overrides side by side, and flags with values may surround them.
    are_keys = ["=" in text and not text.startswith("-") for text in typed]
    at = are_keys.index(True) if True in are_keys else len(typed)
    added = [given, *needed, f"+hydra.job.env_set.{SWEEP_ID}={sweep_id}"]
    sys.argv[1:] = [*typed[:at], *added, *typed[at:]]
    stopped, is_whole = folder / f"{STOP}{sweep_id}", True

    def mark() -> None:
        if folder.is_dir():
            stopped.touch()

    with StopRequest(then=mark) as stop:
        try:
            cli.run_hydra("train", job, TrainConfig)
        except SystemExit:
            if not states_of(folder, sweep_id):
                raise  # a mistake on the command line, which has been printed
            is_whole = False
    if is_whole:  # no job is left to read it
        stopped.unlink(missing_ok=True)
    states = states_of(folder, sweep_id)
    _sum_up(folder, states)
    if stop or not is_whole or not all(state.startswith(FINISHED) for state in states.values()):
        again = shlex.join(["python", "-m", "flowrep.train", *typed[:at], given, *typed[at:]])
        print(f"Continue the remaining runs with\n  {again}")
        sys.exit(stop.exit_code or 1)
    sys.exit(0)


class JobLog:
    """What a run of a sweep printed, with a line for each attempt and for how each one ended."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / LOG

    def begin(self, sweep_id: str) -> None:
        """Adds a line that says which sweep attempts the run."""
        self._add(f"{_BEGUN}{sweep_id} {datetime.now():%Y-%m-%d %H:%M:%S}")

    def end(self, state: str) -> str:
        """Adds how the attempt ended, and returns it."""
        self._add(f"--- {state}")
        return state

    def state(self, sweep_id: str) -> str | None:
        """Returns how the last attempt ended; None if this sweep has not attempted the run."""
        lines = self.path.read_text(encoding="utf-8", errors="replace").splitlines()
        if not any(line.startswith(f"{_BEGUN}{sweep_id} ") for line in lines):
            return None
        has_ended = lines[-1].startswith("--- ") and not lines[-1].startswith(_BEGUN)
        return lines[-1].removeprefix("--- ") if has_ended else STOPPED

    def _add(self, line: str) -> None:
        with open_to_append(self.path) as log:
            log.write(f"{line}\n".encode())


def states_of(sweep: Path, sweep_id: str) -> dict[str, str]:
    """Returns the states of the runs that a sweep has attempted, by name."""
    logs = sorted(sweep.glob(f"*/{LOG}"))
    states = {log.parent.name: JobLog(log.parent).state(sweep_id) for log in logs}
    return {name: state for name, state in states.items() if state is not None}


def _sum_up(folder: Path, states: Mapping[str, str]) -> None:
    """Prints the state of each run, where the logs of failed ones are, and how to compare runs."""
    finished, failed = (
        sum(state.startswith(word) for state in states.values()) for word in (FINISHED, FAILED)
    )
    print(f"sweep: {folder}")
    print(f"{finished} of {len(states)} runs finished{f', {failed} failed' if failed else ''}")
    for name, state in states.items():
        print(f"  {name}: {state}")
        if state.startswith(FAILED):
            print(f"    log: {folder / name / LOG}")
    if finished:
        print(f"Compare them with\n  {shlex.join(['python', '-m', 'flowrep.report', str(folder)])}")


def job(config: DictConfig) -> float:
    """Runs what remains of one run in a separate process; called by Hydra's launchers.

    Returns its final success; nan if a run of a grid has none, so that the others go on.
    """
    hydra = HydraConfig.get()
    folder, sweep = Path(hydra.runtime.output_dir), Path(hydra.sweep.dir)
    is_worker = multiprocessing.current_process().name != "MainProcess"  # of a pool, as joblib's
    if is_worker:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the launching process writes a stop file

    sweep_id = hydra.job.env_set[SWEEP_ID]
    stopped = sweep / f"{STOP}{sweep_id}"

    def should_stop() -> bool:
        return stopped.exists() or (is_worker and os.getppid() != PARENT)

    try:
        JobLog(folder).begin(sweep_id)
        asked = validated(TrainConfig, cli.plain_config(config))
        state = attempted(folder, asked, arguments_of(folder, asked, is_worker), should_stop)
    except Exception as error:  # the other runs go on
        state = JobLog(folder).end(f"{FAILED}: error: {' '.join(str(error).split())}")
    print(f"{folder.name}: {state}", flush=True)
    if is_worker and os.getppid() != PARENT:
        os._exit(1)  # the launching process is gone
    if state.startswith(FINISHED):
        return success_of(folder)
    if hydra.sweeper["_target_"].endswith("BasicSweeper"):
        return float("nan")
    raise RunFailedError(f"{folder} {state}")


def arguments_of(folder: Path, config: TrainConfig, is_worker: bool) -> list[str]:
    """Returns the arguments of `flowrep.train` for a job's run."""
    hydra = HydraConfig.get()
    typed = list(hydra.overrides.task)
    machine = [text for text in typed if text.partition("=")[0] in cli.OF_THE_MACHINE]
    if is_worker and config.num_workers == "auto":  # other workers use the other cores
        machine = [*(text for text in machine if "device" in text), "num_workers=0"]
    if (folder / "config.yaml").is_file():
        maps = config.representations.items()
        targets = {f"+representations.{name}._target_": o.get("_target_") for name, o in maps}
        targets["algorithm._target_"] = config.algorithm.target
        trusted = [cli.override(k, v) for k, v in targets.items() if v and v not in ALGORITHMS]
        return [cli.override("resume", str(folder)), *machine, *trusted]
    line = [cli.override("hydra.run.dir", str(folder)), *typed, *machine]
    line += [text for text in hydra.overrides.hydra if text.startswith("hydra.searchpath=")]
    for source in hydra.runtime.config_sources:
        if source.provider == "command-line":
            line += ["--config-dir", source.path]
    return [*line, "--config-name", str(hydra.job.config_name)]


def attempted(
    folder: Path, config: TrainConfig, line: list[str], should_stop: Callable[[], bool]
) -> str:
    """Runs what remains of a run and returns its state, such as "failed: error: no space".

    `line` are the arguments of `flowrep.train`. Once `should_stop` is true, the run saves and ends.
    """
    _check_is_same(folder, config)
    log, code, begin = JobLog(folder), 0, 0
    if not is_finished(folder, config):
        if should_stop():
            return STOPPED
        print(f"{folder.name}: running", flush=True)
        begin = log.path.stat().st_size if log.path.exists() else 0
        code = _exit_code(line, log.path, should_stop)
    if is_finished(folder, config):
        return log.end(f"{FINISHED}, success {success_of(folder):.0%}")
    if code in {ended for number in STOP_SIGNALS for ended in (128 + number, -number)}:
        return log.end(STOPPED)
    return log.end(f"{FAILED}: {_reason(log.path, begin, code)}")


def _exit_code(line: list[str], log: Path, should_stop: Callable[[], bool]) -> int:
    """Runs `flowrep.train` to its end and returns its exit code, minus the signal that ended it."""
    environment = {k: v for k, v in os.environ.items() if k != "HYDRA_FULL_ERROR"}
    with open_to_append(log) as file:
        run = subprocess.Popen(
            [*TRAIN, *line], stdin=subprocess.DEVNULL, stdout=file, stderr=file, env=environment,
            preexec_fn=_end_with_parent,
        )  # fmt: skip
        try:
            while run.poll() is None and not should_stop():
                time.sleep(POLL_S)
        finally:  # a launcher may end its worker with an exception
            if run.poll() is None:
                run.terminate()
            run.wait()
    return run.returncode


def _end_with_parent() -> None:
    """Makes a process save and end when its parent ends, even if that is killed."""
    for number in (signal.SIGUSR1, signal.SIGUSR2):  # SLURM sends them for its launcher
        signal.signal(number, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def _reason(log: Path, begin: int, code: int) -> str:
    """Returns why a run failed: the last error in its log, or the signal that ended it."""
    if code < 0:
        hint = ": is there enough memory?" if -code == signal.SIGKILL else ""
        return f"ended by {signal.Signals(-code).name}{hint}"
    text = log.read_bytes()[begin:].decode(errors="replace")
    lines = [line.strip() for line in re.split(r"[\r\n]", text)]  # a bar's line ends in "\r"
    errors = [line for line in lines if line.startswith("error: ")]
    return (errors or [x for x in lines if x] or [f"exit code {code}"])[-1]


def _check_is_same(folder: Path, config: TrainConfig) -> None:
    """Checks that a folder holds the run that the sweep asks for, or none."""
    path = folder / "config.yaml"
    if not path.is_file():
        return
    stored = validated_run(read_yaml(path), str(path), config.trusted).plain()
    asked = config.plain()
    if asked["algorithm"].get("precision", "auto") == "auto":  # the run has resolved it
        asked["algorithm"] |= {k: v for k, v in stored["algorithm"].items() if k == "precision"}
    for key, value in asked.items():
        if key not in (*cli.OF_THE_MACHINE, "resume") and stored.get(key) != value:
            raise UsageError(
                f"'{folder}' holds a run with {key}={stored.get(key)}, the sweep asks for {value}: "
                "give the sweep another folder with hydra.sweep.dir=, or move it away"
            )
