"""Stops a run on Ctrl-C or SIGTERM without losing anything."""

import signal
from types import FrameType
from typing import Any


class StopRequest:
    """Turns SIGINT and SIGTERM into a flag that the loop checks between two steps.

    The first signal sets `received`. Another Ctrl-C ends the process at once; another SIGTERM
    doesn't, since schedulers send it to each process of a job and more than once. Use it as a
    context manager; the previous handlers are restored on exit.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        """Starts without a signal; handlers are installed on entering."""
        self.received: signal.Signals | None = None
        self._previous: dict[signal.Signals, Any] = {}

    @property
    def exit_code(self) -> int:
        """The exit code that shells expect of a process ended by the received signal."""
        return 0 if self.received is None else 128 + self.received

    def __bool__(self) -> bool:
        """Returns whether a stop was requested."""
        return self.received is not None

    def __enter__(self) -> "StopRequest":
        """Installs the handlers."""
        self._previous = {number: signal.signal(number, self._receive) for number in self.SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        """Restores the previous handlers."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _receive(self, number: int, _: FrameType | None) -> None:
        self.received = self.received or signal.Signals(number)
        signal.signal(signal.SIGINT, self._previous[signal.SIGINT])
