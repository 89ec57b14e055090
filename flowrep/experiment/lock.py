"""The lock of a run's folder, in which only one process at a time works."""

import errno
import fcntl
import json
import os
import platform
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path

from flowrep.files import naming


class RunFolderError(ValueError):
    """A folder holds no run, or holds one where a new run should begin."""


class FolderInUseError(OSError):
    """Another process works in the folder."""


class FolderLock:
    """A locked file in a folder, in which the process that holds the folder describes itself.

    The kernel's lock is on the open file and ends with the process, even if it is killed. The file
    stays: if a holder removed it, two processes could hold the old file and a new one of its name.
    """

    _NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # raised by some network disks

    def __init__(self, folder: Path) -> None:
        self._path, self._text = folder / ".lock", b""
        # O_NOFOLLOW refuses links; with O_NONBLOCK, a named pipe doesn't wait for its other end.
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        try:
            self._file = os.open(self._path, flags, 0o666)
            status = os.fstat(self._file)
            is_plain = stat.S_ISREG(status.st_mode) and status.st_nlink < 2
        except OSError as error:
            if error.errno != errno.ELOOP:
                raise
            is_plain = False
        if not is_plain:
            raise RunFolderError(
                f"'{self._path}' is a link, or not a regular file, which no run creates: remove it"
            )

    def take(self, doing: str) -> bool:
        """Locks the file; returns False if another process holds it."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno not in self._NO_LOCKS:
                raise
            if platform.node() in self.holder():  # a live process of this machine
                return False
            print(f"warning: no locks on the disk of '{self._path}' ({error})", file=sys.stderr)
        if not self._is_at_its_path():  # replaced since it was opened
            return False
        now = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
        text = {"pid": os.getpid(), "host": platform.node(), "doing": doing, "since": now}
        text["note"] = "free once that process has ended; if this file is removed, two can run"
        self._text = json.dumps(text).encode()
        with naming(self._path):
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, self._text, 0)
        return True

    def check(self) -> None:
        """Raises RunFolderError if another process may have taken the folder since."""
        if not (self._is_at_its_path() and self._is_ours()):
            raise RunFolderError(
                f"'{self._path}' was removed or replaced, so another process can take the folder: "
                "this one stops, and has written nothing since. Leave that file alone during a run"
            )

    def holder(self) -> str:
        """Describes the process that wrote the file; empty if that process has ended."""
        try:
            entry = json.loads(os.pread(self._file, 4096, 0))
            pid, host = int(entry["pid"]), entry["host"]
            text = f"process {pid} on {host} has been {entry['doing']} in it since {entry['since']}"
        except (ValueError, KeyError, TypeError):  # empty, or written by something else
            return ""
        if host == platform.node() and not _is_alive(pid):
            return ""
        return "".join(filter(str.isprintable, text))

    def close(self) -> None:
        """Releases the folder."""
        if self._text and self._is_ours():
            os.ftruncate(self._file, 0)
        os.close(self._file)

    def _is_at_its_path(self) -> bool:
        try:
            return os.path.samestat(os.fstat(self._file), os.lstat(self._path))
        except FileNotFoundError:
            return False

    def _is_ours(self) -> bool:
        # On a disk without locks, another process may have written to the file since.
        return os.pread(self._file, len(self._text) + 1, 0) == self._text


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # of another user
        pass
    return True


@contextmanager
def locked(folder: Path, doing: str, patience_s: float = 0.0) -> Iterator[FolderLock]:
    """Locks a folder against other processes until the context, or the process, ends.

    Waits `patience_s` for another process to release it. `doing` is what this process does, for the
    error message in other processes.
    """
    until = time.monotonic() + patience_s
    while True:
        with closing(FolderLock(folder)) as lock:
            if lock.take(doing):
                yield lock
                return
            if time.monotonic() >= until:
                holder = lock.holder() or "another process has just taken it"
                raise FolderInUseError(
                    f"'{folder}' is in use: {holder}. Wait until it has ended, or stop it"
                )
        time.sleep(0.5)
