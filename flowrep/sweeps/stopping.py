"""Stops a sweep so that every run saves, from the launching process through workers to runs."""

import os
import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

_MARK = ".stop"


def is_stopped(sweep: Path) -> bool:
    """Returns whether the sweep in this folder should stop."""
    return (sweep / _MARK).exists()


class SweepStop:
    """Turns SIGINT and SIGTERM in the launching process into a marker file in the sweep's folder.

    Workers on any machine look for it. A second signal ends this process at once; the file then
    stays until the sweep is continued, for jobs that are still queued. Use it as a context manager.

    Args:
        sweep: the sweep's folder, which exists.
    """

    def __init__(self, sweep: Path) -> None:
        self.received: signal.Signals | None = None
        self._mark = sweep / _MARK
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "SweepStop":
        """Installs the handlers."""
        self._mark.unlink(missing_ok=True)
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        """Restores the handlers, and removes the marker unless jobs may still have to see it."""
        self._give_back()
        if error is None or self.received is None:
            self._mark.unlink(missing_ok=True)

    def _receive(self, number: int, _: FrameType | None) -> None:
        self.received = signal.Signals(number)
        self._mark.touch()
        self._give_back()
        print("stopping once each run has saved; repeat to end at once", file=sys.stderr)

    def _give_back(self) -> None:
        for each, handler in self._previous.items():
            signal.signal(each, handler)


def stop_when_closed(descriptor: int) -> None:
    """Sends SIGTERM to this process when the other end of a pipe is closed.

    The other end is closed however the process that holds it ends.
    """

    def watch() -> None:
        while os.read(descriptor, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()
