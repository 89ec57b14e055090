"""A lock that lets one process at a time work in a run's folder."""

import errno
import fcntl
import json
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # raised by some network file systems


class FolderInUseError(OSError):
    """Another process works in the folder; the message says which."""


@contextmanager
def folder_lock(folder: Path, doing: str) -> Iterator[None]:
    """Locks a folder against other processes.

    The lock is released when the process ends, however it ends.

    Args:
        folder: an existing folder; `.lock` is created in it and kept.
        doing: the activity, for the error that other processes get, e.g. "training".

    Raises:
        FolderInUseError: another process holds the folder; gives its id, host and start time.
    """
    with (folder / ".lock").open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise FolderInUseError(
                f"'{folder}' is in use: {_holder(file.name)}. Wait until it has ended, or stop it"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            print(f"warning: no locks on the disk of '{folder}' ({error})", file=sys.stderr)
        file.truncate(0)
        now = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
        holder = {"pid": os.getpid(), "host": platform.node(), "doing": doing, "since": now}
        json.dump(holder, file)
        file.flush()
        try:
            yield
        finally:
            file.truncate(0)


def _holder(lock: str) -> str:
    """Describes the process that wrote a lock file."""
    try:
        holder = json.loads(Path(lock).read_text(encoding="utf-8"))
        return "process {pid} on {host} has been {doing} in it since {since}".format(**holder)
    except (ValueError, KeyError, TypeError):  # it has not written its description yet
        return "another process has just begun in it"
