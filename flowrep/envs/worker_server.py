"""The process that workers are forked from: what it imports, and what it leaves behind."""

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


def server_context(module: str) -> Any:
    """Returns a context of multiprocessing whose fork server runs.

    SIGINT and SIGTERM, which terminals and schedulers send to whole process groups, reach neither
    the server nor what it forks, from their first moment on: they end when the caller closes, or is
    gone.

    Args:
        module: is imported by the server, once for all workers, with all that it imports.

    Raises:
        OSError: the path of the folder for temporary files is too long.
    """
    context: Any = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([module])
    resource_tracker.ensure_running()  # which unblocks signals when it starts
    with signals_held(), _folder_told():
        forkserver.ensure_running()
    return context


@contextmanager
def signals_held() -> Iterator[None]:
    """Has SIGINT and SIGTERM wait for the end of the block; what begins in it never hears them.

    A process inherits the mask, and multiprocessing leaves it as it is. A worker whose caller ends
    while it is begun would tell of the half of its task that it was given.
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
    # This is the server. Its socket lies in a folder that the caller removes; a caller that is
    # killed can't, and is outlived by its server for a moment.
    atexit.register(shutil.rmtree, os.environ.pop(_FOLDER), ignore_errors=True)
