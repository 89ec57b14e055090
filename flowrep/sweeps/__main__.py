"""`python -m flowrep.sweeps`: starts or continues the run that a JSON object on stdin describes.

    {"folder": ..., "config": {...}, "machine": {"device": ..., "num_workers": ...},
     "overrides": [...]}

The run saves and stops when stdin is closed, that is, when the requesting process has ended. It
ignores SIGUSR1 and SIGUSR2, which SLURM sends to all processes of a job whose time is nearly over;
only the requesting process handles them.
"""

import json
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

from flowrep.config import UsageError, validated
from flowrep.config.algorithms import ALGORITHMS
from flowrep.config.command_line import exit_with
from flowrep.config.training import TrainConfig
from flowrep.experiment.run import FolderInUseError, RunFolder, RunFolderError, differences
from flowrep.scenes import SceneError, load_scene
from flowrep.sweeps.ending import FINISHED, Ending
from flowrep.sweeps.job import definition
from flowrep.sweeps.stopping import stop_when_closed
from flowrep.tables import TableError
from flowrep.train import carry_out

PATIENCE_S = 60.0  # to wait for a run of the same sweep that is saving after a stop


def main() -> None:
    """Does what remains of the run; an error becomes a line of its log."""
    for number in (signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(number, signal.SIG_IGN)
    request = json.loads(sys.stdin.buffer.readline())
    stop_when_closed(sys.stdin.fileno())
    try:
        folder = RunFolder(request["folder"])
        with held_soon(folder):
            config = started_or_found(folder, request)
            success = carry_out(config, folder)
            Ending(FINISHED, success).write(folder.path)
    except (UsageError, SceneError, RunFolderError, TableError, OSError) as error:
        exit_with(error)


@contextmanager
def held_soon(folder: RunFolder) -> Iterator[None]:
    """Locks a run's folder, waiting for a while if it is in use."""
    until = time.monotonic() + PATIENCE_S
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(folder.held("training"))
                break
            except FolderInUseError:
                if time.monotonic() > until:
                    raise
                time.sleep(1.0)
        yield


def started_or_found(folder: RunFolder, request: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the config of the requested run, after writing it to its folder if it is new.

    Raises:
        RunFolderError: the folder holds another run.
        UsageError, SceneError: the requested config is invalid.
    """
    asked = request["config"]
    target = asked["algorithm"]["_target_"]
    # it was named on the sweep's command line
    trust = {} if target in ALGORITHMS else {"trust": target}
    if not (folder.path / "config.yaml").is_file():
        own_keys = asked.keys() - TrainConfig.keys()
        validated(TrainConfig, asked, own_keys)
        load_scene(asked["scene"])
        folder.check_is_new()
        folder.write_config(asked, request["overrides"])
        return asked | request["machine"] | trust
    stored = folder.read_config()
    for place, there, here in differences(definition(stored), definition(asked)):
        raise RunFolderError(
            f"'{folder.path}' holds a run with {place}={there}, the sweep asks for {here}: give "
            "the sweep another folder with hydra.sweep.dir=, or move that run away"
        )
    return stored | request["machine"] | trust | {"resume": str(folder.path)}


if __name__ == "__main__":
    main()
