"""Runs one job of a sweep in a launcher's worker: starts a process and waits for it.

Workers import this module alone, so it imports no torch.
"""

import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from flowrep.config.command_line import plain_config, register_resolvers
from flowrep.config.run_names import OF_THE_MACHINE
from flowrep.sweeps.ending import FAILED, FINISHED, LOG, STOPPED, Ending
from flowrep.sweeps.stopping import is_stopped

register_resolvers()  # for the paths in conf/run_folder.yaml, which a worker resolves too

POLL_S = 0.5
PARENT = os.getppid()
BUSY = threading.Lock()  # held while a run is waited for
RUN = (sys.executable, "-m", "flowrep.sweeps")
_BASIC_SWEEPER = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"


class RunFailedError(RuntimeError):
    """A run of a sweep has no result."""


def job(config: DictConfig) -> float:
    """Does what remains of one run in a process of its own; called by Hydra's launchers.

    Returns:
        Its share of final greedy episodes that succeed; nan if a run of a grid has none, so that
        the other runs go on.

    Raises:
        RunFailedError: the run has no result, and its sweeper needs one.
    """
    hydra = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    is_worker = multiprocessing.current_process().name != "MainProcess"  # of a pool, as joblib's
    plain = plain_config(config)
    machine = {key: plain[key] for key in ("device", "num_workers")}
    if is_worker and plain["num_workers"] == "auto":  # it has only its own core
        machine["num_workers"] = 0
    request = {
        "folder": str(folder),
        "config": plain,
        "machine": machine,
        "overrides": list(hydra.overrides.task),
    }

    def should_stop() -> bool:
        return is_stopped(Path(hydra.sweep.dir)) or (is_worker and os.getppid() != PARENT)

    if is_worker:
        _end_with_launcher()
    with BUSY:
        ending = supervised(request, should_stop)
    if ending.success is not None:
        return ending.success
    if hydra.sweeper["_target_"] == _BASIC_SWEEPER:
        return float("nan")
    raise RunFailedError(f"{folder} {ending.how}: {ending.message}")


@cache
def _end_with_launcher() -> None:
    """Makes a pool's worker end with the launching process, which it would otherwise outlive."""

    def watch() -> None:
        while os.getppid() == PARENT:
            time.sleep(1.0)
        with BUSY:
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def supervised(request: Mapping[str, Any], should_stop: Callable[[], bool]) -> Ending:
    """Runs the requested run, unless it is finished, and returns its ending.

    Args:
        request: the request for `flowrep.sweeps.__main__`.
        should_stop: polled; once it returns true, the run saves and ends.
    """
    folder = Path(request["folder"])
    try:
        return _attempted(folder, request, should_stop)
    except Exception as error:  # the other runs go on, and the summary has the reason
        ending = Ending(FAILED, message=" ".join(f"error: {error}".split()))
        ending.keep(folder)
        return ending


def _attempted(folder: Path, request: Mapping[str, Any], should_stop: Callable[[], bool]) -> Ending:
    ending = Ending.read(folder)
    if ending is not None and ending.how == FINISHED and _is_same(folder, request["config"]):
        return ending
    if should_stop():
        return Ending(STOPPED)
    Ending.forget(folder)
    _leave_ctrl_c_to_the_launcher()
    with (folder / LOG).open("ab", buffering=0) as log:
        log.write(f"--- {datetime.now().astimezone():%Y-%m-%d %H:%M:%S%z}\n".encode())
        begin = log.tell()
        # a session of its own: signals reach the run through this process alone
        with subprocess.Popen(
            RUN, stdin=subprocess.PIPE, stdout=log, stderr=log, start_new_session=True
        ) as run:
            code = _wait(run, json.dumps(request), should_stop)
    ending = Ending.read(folder)
    if ending is None:
        ending = _without_result(folder / LOG, begin, code)
        ending.keep(folder)
    return ending


def _wait(run: subprocess.Popen[bytes], request: str, should_stop: Callable[[], bool]) -> int:
    """Returns a run's exit code; if this process ends first, the run saves and ends too."""
    assert run.stdin is not None
    is_told = False
    try:
        run.stdin.write(request.encode() + b"\n")
        run.stdin.flush()
        while run.poll() is None:
            if should_stop() and not is_told:
                run.terminate()
                is_told = True
            time.sleep(POLL_S)
    except BrokenPipeError:  # it ended before reading; its log says why
        pass
    finally:
        if run.poll() is None and not is_told:
            run.terminate()
    return run.wait()


def _without_result(log: Path, begin: int, code: int) -> Ending:
    """Returns the ending of a run that wrote none: stopped by a signal it handles, or failed."""
    if code in (128 + signal.SIGINT, 128 + signal.SIGTERM, -signal.SIGTERM):
        return Ending(STOPPED)
    if code < 0:
        name = signal.Signals(-code).name
        hint = ": is there enough memory?" if -code == signal.SIGKILL else ""
        return Ending(FAILED, message=f"ended by {name}{hint}")
    text = log.read_bytes()[begin:].decode(errors="replace")
    lines = [line.strip() for line in re.split(r"[\r\n]", text)]  # a bar's line ends in "\r"
    errors = [line for line in lines if line.startswith("error: ")]
    last = [line for line in lines if line][-1:]
    return Ending(FAILED, message=(errors or last or [f"exit code {code}"])[-1])


def _is_same(folder: Path, config: Mapping[str, Any]) -> bool:
    """Returns whether `config` defines a run; `flowrep.sweeps.__main__` reports a difference."""
    try:
        stored = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, ValueError, RecursionError):
        return False
    return isinstance(stored, dict) and definition(stored) == definition(config)


def definition(config: Any) -> Any:
    """Returns the part of a config that defines a run, as plain JSON data."""
    other = (*OF_THE_MACHINE, "resume")
    kept = {k: v for k, v in config.items() if k not in other} if config else config
    return json.loads(json.dumps(kept, default=str))  # str: of a date


def _leave_ctrl_c_to_the_launcher() -> None:
    """Ignores Ctrl-C in a worker permanently, since it may be waiting for its next job.

    The launching process has a handler of its own, which stays, and marks the sweep as stopped.
    """
    is_default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_default and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
