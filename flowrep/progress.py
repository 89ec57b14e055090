"""How a long loop is stopped, what happens in it at intervals, and where its time goes."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any


class StopRequest:
    """Turns SIGINT and SIGTERM into a flag that the loop checks between two steps.

    The first signal sets `received` and calls `then`. Another Ctrl-C ends the process at once;
    another SIGTERM doesn't, since schedulers send it to each process of a job and more than once.
    The previous handlers are restored when its context ends.
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
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _receive(self, number: int, _: FrameType | None) -> None:
        if self.received is None:
            self.received = signal.Signals(number)
            self._then()
        signal.signal(signal.SIGINT, self._previous[signal.SIGINT])


@dataclass
class Every:
    """True once each time a step counter passes a multiple of `interval`, 0 for never."""

    interval: int
    last: int = 0

    def __call__(self, step: int) -> bool:
        """Returns whether `step` reached or jumped over a multiple since the last call."""
        if not self.interval or step // self.interval <= self.last // self.interval:
            return False
        self.last = step
        return True


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
        """Returns the shares of all sections in one line, the largest first."""
        ordered = sorted(self.seconds, key=self.seconds.__getitem__, reverse=True)
        return ", ".join(f"{name} {self.share(name):.0%}" for name in ordered)
