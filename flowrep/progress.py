"""Long loops: how far one is, where its time goes, and a stop between two of its steps."""

import io
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
"""Ctrl-C; what schedulers send; a closed terminal; what SLURM's --signal=USR1@300 sends."""

LINE_EVERY_S = 30.0
_LOCK = threading.RLock()


def progress_bar(iterable: Any = None, *, what: str, **options: Any) -> Any:
    """Returns a tqdm bar; where stderr is no terminal, it prints a plain line each half minute.

    Args:
        iterable: what the bar counts, as for tqdm; None to count with `update`.
        what: begins the plain lines, and a terminal's bar unless `desc` is given.
        options: those of tqdm.
    """
    from tqdm.asyncio import tqdm_asyncio  # here, as envs import this module and need no tqdm
    from tqdm.auto import tqdm

    # tqdm's default lock is one between processes, for which multiprocessing starts its resource
    # tracker, and a hang-up would make that print a traceback.
    tqdm.set_lock(_LOCK)
    is_notebook = tqdm is not tqdm_asyncio
    if sys.stderr.isatty() or is_notebook:
        return tqdm(iterable, **{"desc": what} | options)
    line = what + ": {n_fmt} {unit}s, {rate_fmt}{postfix}"
    if options.get("total") is not None or hasattr(iterable, "__len__"):
        line = what + ": {n_fmt} of {total_fmt} {unit}s, {rate_fmt}, {remaining} left{postfix}"
    return tqdm(iterable, **options | {"file": _Lines(), "bar_format": line})


class _Lines(io.TextIOBase):
    """A file for tqdm that prints its text as a line each half minute, without cursor moves."""

    def __init__(self) -> None:
        super().__init__()
        self._written_at = time.monotonic()

    def write(self, text: str) -> int:
        line, now = text.strip("\r\n "), time.monotonic()
        # A bar that is below another one moves the cursor first.
        if line and not line.startswith("\x1b") and now - self._written_at >= LINE_EVERY_S:
            self._written_at = now
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()
        return len(text)


class Stopwatch:
    """Adds up wall time by section.

    >>> clock = Stopwatch()
    >>> with clock("update"):
    ...     pass
    >>> clock.share("update")
    1.0
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, section: str) -> Iterator[None]:
        """Adds the time spent inside to `section`."""
        start = time.perf_counter()
        yield
        elapsed = time.perf_counter() - start
        self.seconds[section] = self.seconds.get(section, 0.0) + elapsed

    def share(self, section: str) -> float:
        """Returns the share of all counted time that a section took; 0 at first."""
        return self.seconds.get(section, 0.0) / (sum(self.seconds.values()) or 1.0)

    def summary(self) -> str:
        """Returns the share of each section in one line, the largest first."""
        ordered = sorted(self.seconds, key=self.seconds.__getitem__, reverse=True)
        return ", ".join(f"{name} {self.share(name):.0%}" for name in ordered)


class StopRequest:
    """Turns `STOP_SIGNALS` into a flag that the loop checks between two steps.

    The first signal sets `received` and calls `then`. A second Ctrl-C ends the process at once; a
    second SIGTERM doesn't, since schedulers send it to each process of a job and more than once.
    If SIGHUP is ignored, as under `nohup`, it stays so. The previous handlers are restored when the
    context ends. In another thread than the main one, a request never comes.
    """

    def __init__(self, then: Callable[[], Any] = lambda: None) -> None:
        self.received: signal.Signals | None = None
        self._then = then
        self._previous: dict[signal.Signals, Any] = {}

    @property
    def exit_code(self) -> int:
        """The exit code that shells expect of a process ended by the signal."""
        return 0 if self.received is None else 128 + self.received

    def __bool__(self) -> bool:
        return self.received is not None

    def __enter__(self) -> "StopRequest":
        if threading.current_thread() is not threading.main_thread():
            return self  # signals reach the main thread alone
        for number in STOP_SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _receive(self, number: int, _: FrameType | None) -> None:
        if number == signal.SIGHUP:
            _leave_closed_terminal()
        if self.received is None:
            self.received = signal.Signals(number)
            self._then()
        signal.signal(signal.SIGINT, self._previous[signal.SIGINT])


def _leave_closed_terminal() -> None:
    """Discards further output if its terminal was closed, as printing would raise an error."""
    for descriptor in (1, 2):
        poll = select.poll()
        poll.register(descriptor, 0)  # hang-ups and errors are always reported
        if poll.poll(0):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, descriptor)
            os.close(nowhere)
