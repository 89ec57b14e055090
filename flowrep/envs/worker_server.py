"""How worker processes start: the fork server of several, its imports, signals and files."""

import atexit
import multiprocessing
import os
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker, util
from typing import Any

_FOLDER = "FLOWREP_WORKER_SERVER_FOLDER"
_LONGEST_FOLDER = 107 - len("/listener-12345678")  # bytes: a socket's path has 107 at most


def worker_context(module: str, num_workers: int) -> Any:
    """Returns a multiprocessing context that starts workers.

    Several are forked from a server, which is running by then and imports what they need once. A
    single one is a new interpreter, since a server beside it would only hold a second copy of that.

    SIGINT and SIGTERM, which terminals and schedulers send to whole process groups, never reach the
    server or workers started under `signals_held`. They end when the caller closes them or dies.

    Args:
        module: imported by the server, with its own imports, if no server is running yet.
        num_workers: the number of workers that will be started together.

    Raises:
        OSError: the path of the folder for temporary files is too long for the server's socket.
    """
    resource_tracker.ensure_running()  # which unblocks signals when it starts
    if num_workers == 1:
        return multiprocessing.get_context("spawn")
    context: Any = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([module, "flowrep.envs.worker_freeze"])
    with signals_held(), _folder_told():
        forkserver.ensure_running()
    return context


@contextmanager
def signals_held() -> Iterator[None]:
    """Blocks SIGINT and SIGTERM during the block, permanently in processes started in it.

    A process inherits the mask, and multiprocessing does not change it. A worker whose caller is
    interrupted while starting it would print an error about its incomplete arguments.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _folder_told() -> Iterator[None]:
    folder = util.get_temp_dir()
    if len(os.fsencode(folder)) > _LONGEST_FOLDER:
        raise OSError(f"'{folder}' is too long for sockets: shorten TMPDIR, or set num_workers=0")
    os.environ[_FOLDER] = folder
    try:
        yield
    finally:
        del os.environ[_FOLDER]


if _FOLDER in os.environ:
    # This runs in the server. The caller removes the folder of its socket; a killed caller can't,
    # and its server outlives it for a moment.
    atexit.register(shutil.rmtree, os.environ.pop(_FOLDER), ignore_errors=True)
