"""Sweeps: `python -m flowrep.train -m seed=0,1,2` trains a run for each job, each in a folder.

A job trains in a process of its own, see `flowrep.train.run_sweep_job`. If its run has begun
already, that resumes it, and if its final evaluation is done, there is nothing to do. So the same
command continues a sweep, whatever stopped it. Hydra's launchers (one run after the other, joblib,
SLURM, Ray) call `job` in their workers, so this module imports no PyTorch.
"""

from __future__ import annotations

import ctypes
import json
import multiprocessing
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import datetime
from itertools import product
from pathlib import Path
from typing import IO, Any, NoReturn

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from flowrep.config import cli
from flowrep.config.config_dir import checked_files
from flowrep.config.run_names import OF_THE_MACHINE, register_resolvers, settings_of, sweep_run_name
from flowrep.config.usage import UsageError
from flowrep.config.yaml_file import read_yaml
from flowrep.experiment.outcomes import is_finished, success_of
from flowrep.experiment.schema import TrainConfig, validated_run
from flowrep.files import open_to_append
from flowrep.progress import STOP_SIGNALS, StopRequest

register_resolvers()  # for the paths in conf/run_folder.yaml, which a worker resolves too
if multiprocessing.current_process().name != "MainProcess":
    # A launcher's pool worker composes its jobs itself, so their files are checked here; never
    # left, because the process does nothing else.
    _CHECKED = checked_files()
    _CHECKED.__enter__()

LOG = "job.log"
STOP = ".stop"
"""A file in a sweep's folder that makes its jobs, on any machine, save and stop."""
TRAIN = "from flowrep.train import run_sweep_job; run_sweep_job()"
POLL_S = 0.5
# A process whose parent ends gets another one: so a worker notices that its launcher was killed.
PARENT = os.getppid()
BEGUN, FINISHED, FAILED, STOPPED = "begun", "finished", "failed", "stopped"


def is_sweep(arguments: list[str]) -> bool:
    """Returns whether a command line starts several runs."""
    return bool({"-m", "--multirun", "hydra.mode=MULTIRUN"} & {*arguments})


def run_sweep() -> NoReturn:
    """Runs the sweep of `sys.argv`, prints how its runs ended, and ends the process."""
    # Hydra takes ++ and + in front of keys.
    keys = [text.lstrip("+").partition("=")[0] for text in sys.argv[1:]]
    if "resume" in keys:
        cli.exit_with(
            "resume= continues one run; to continue a sweep, repeat its command with "
            "hydra.sweep.dir=<its folder>"
        )
    if "hydra.run.dir" in keys:
        cli.exit_with("hydra.run.dir= is of a single run; for a sweep, give hydra.sweep.dir=")
    typed = [text for text, key in zip(sys.argv[1:], keys) if key != "hydra.sweep.dir"]
    folders = [cli.value_of(text) for text in sys.argv[1:] if text not in typed]
    new = f"outputs/{datetime.now():%Y-%m-%d/%H-%M-%S}_sweep"
    folder = Path(folders[-1] if folders else new).expanduser().absolute()
    given = cli.override("hydra.sweep.dir", str(folder))
    # argparse needs all overrides side by side, and flags with values may surround them.
    are_keys = ["=" in text and not text.startswith("-") for text in typed]
    at = are_keys.index(True) if True in are_keys else len(typed)
    sys.argv[1:] = [*typed[:at], given, *typed[at:]]

    def mark() -> None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / STOP).touch()

    (folder / STOP).unlink(missing_ok=True)
    code: Any = 0
    with StopRequest(then=mark) as stop:
        try:
            cli.run_hydra("train", job, TrainConfig)
        except SystemExit as end:  # its reason has been printed
            code = end.code
    logs = sorted(filter(Path.is_file, folder.rglob(LOG)))  # hydra.sweep.subdir= may have folders
    states = {str(log.parent.relative_to(folder)): state_of(log) for log in logs}
    if not states:  # a mistake on the command line
        sys.exit(stop.exit_code or code)
    finished = sum(state.startswith(FINISHED) for state in states.values())
    print(f"sweep: {folder}\n{finished} of {len(states)} runs finished")
    for name, state in states.items():
        print(f"  {name}: {state}")
        if state.startswith(FAILED):
            print(f"    log: {folder / name / LOG}")
    if finished:
        print(f"Compare them with\n  {shlex.join(['python', '-m', 'flowrep.report', str(folder)])}")
    if stop or code or finished < len(states):
        again = shlex.join(["python", "-m", "flowrep.train", *typed[:at], given, *typed[at:]])
        print(f"Continue the remaining runs with\n  {again}")
        sys.exit(stop.exit_code or code or 1)
    sys.exit(0)


def state_of(log: Path) -> str:
    """Returns how the last attempt of a run ended, by its log."""
    last = log.read_text(encoding="utf-8", errors="replace").rstrip("\n").rpartition("\n")[2]
    has_ended = last.startswith("--- ") and not last.startswith(f"--- {BEGUN}")
    return last.removeprefix("--- ") if has_ended else STOPPED


def job(config: DictConfig) -> None:
    """Runs what remains of one run in a separate process; called by Hydra's launchers."""
    hydra = HydraConfig.get()
    folder, stopped = Path(hydra.runtime.output_dir), Path(hydra.sweep.dir) / STOP
    is_worker = multiprocessing.current_process().name != "MainProcess"  # of a pool, as joblib's
    if is_worker:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the launching process marks the stop
    with open_to_append(folder / LOG) as log:
        log.write(f"--- {BEGUN} {datetime.now():%Y-%m-%d %H:%M:%S}\n".encode())
        try:
            asked: TrainConfig = cli.checked(config, TrainConfig)
            if is_worker and asked.num_workers == "auto":  # other workers use the other cores
                asked = asked.model_copy(update={"num_workers": 0})
            state = attempted(
                folder, asked, log,
                lambda: stopped.exists() or (is_worker and os.getppid() != PARENT),
                settings=settings_of(hydra.runtime.choices),
            )  # fmt: skip
        except Exception as error:  # the other runs go on
            state = f"{FAILED}: error: {' '.join(str(error).split())}"
        log.write(f"--- {state}\n".encode())
    print(f"{folder.name}: {state}", flush=True)


def attempted(
    folder: Path,
    asked: TrainConfig,
    log: IO[bytes],
    should_stop: Callable[[], bool],
    **begun: Any,  # what a new run's folder and first lines say
) -> str:
    """Runs what remains of a run and returns its state, such as "failed: error: no space".

    Once `should_stop` is true, the run saves and ends.
    """
    _check_is_same(folder, asked)
    code, begin = 0, log.tell()
    if not is_finished(folder, asked):
        if should_stop():
            return STOPPED
        print(f"{folder.name}: running", flush=True)
        request = {"folder": str(folder), "config": asked.plain(), **begun}
        code = _exit_code(json.dumps(request), log, should_stop)
    if is_finished(folder, asked):
        return f"{FINISHED}, success {success_of(folder):.0%}"
    if code in {ended for number in STOP_SIGNALS for ended in (128 + number, -number)}:
        return STOPPED
    if code < 0:
        hint = ": is there enough memory?" if -code == signal.SIGKILL else ""
        return f"{FAILED}: ended by {signal.Signals(-code).name}{hint}"
    text = Path(log.name).read_bytes()[begin:].decode(errors="replace")
    lines = [line.strip() for line in re.split(r"[\r\n]", text)]  # a bar's line ends in "\r"
    errors = [line for line in lines if line.startswith("error: ")]
    return f"{FAILED}: {(errors or [x for x in lines if x] or [f'exit code {code}'])[-1]}"


def _exit_code(request: str, log: IO[bytes], should_stop: Callable[[], bool]) -> int:
    """Runs `TRAIN` in a process and returns its exit code, minus the signal that ended it."""
    # A run that fails has to print a line, which becomes its state, and no traceback.
    environment = {k: v for k, v in os.environ.items() if k != "HYDRA_FULL_ERROR"}
    with subprocess.Popen(
        [sys.executable, "-c", TRAIN], stdin=subprocess.PIPE, stdout=log, stderr=log,
        env=environment, preexec_fn=_end_with_parent,
    ) as run:  # fmt: skip
        try:
            assert run.stdin is not None
            run.stdin.write(request.encode())
            run.stdin.close()
            while run.poll() is None and not should_stop():
                time.sleep(POLL_S)
        finally:  # a launcher may end its worker with an exception
            if run.poll() is None:
                run.terminate()
            run.wait()
    return run.returncode


def _end_with_parent() -> None:
    """Makes a process save and end when its parent ends, even if that is killed."""
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)  # SLURM sends it for its launcher
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def check_folders_differ(hydra: DictConfig) -> None:
    """Checks that no two runs of a sweep have the same folder, where only one would be run."""
    typed: Any = OmegaConf.to_container(hydra.sweep, resolve=False)
    if "sweep_run_name" not in typed["subdir"]:  # named by the user, perhaps by ${hydra.job.num}
        return
    values: dict[str, list[str]] = {}
    listed = [f"{key}={value}" for key, value in (hydra.sweeper.params or {}).items()]
    for text in [*listed, *hydra.overrides.task]:
        given = cli.parsed(text)
        if given is not None and (given.is_choice_sweep() or given.is_range_sweep()):
            key = given.get_key_element()
            values[key] = [f"{key}={value}" for value in given.sweep_string_iterator()]
        else:
            values[text.partition("=")[0]] = [text]
    names = [sweep_run_name(each) for each in product(*values.values())]
    if twice := [name for i, name in enumerate(names) if name in names[:i]]:
        raise UsageError(
            f"the sweep has two runs for its folder {twice[0]}: leave out values that are given "
            f"twice, and compare values of {', '.join(OF_THE_MACHINE)} in a sweep each"
        )


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
        if key not in (*OF_THE_MACHINE, "resume") and stored.get(key) != value:
            raise UsageError(
                f"'{folder}' holds a run with {key}={stored.get(key)}, the sweep asks for {value}: "
                "give the sweep another folder with hydra.sweep.dir=, or move it away"
            )
