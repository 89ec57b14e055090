"""The wall time of a run by section."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Adds up wall time by section.

    >>> clock = Stopwatch()
    >>> with clock("update"):
    ...     pass
    >>> clock.share("update")
    1.0
    """

    def __init__(self) -> None:
        """Starts with no sections."""
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, section: str) -> Iterator[None]:
        """Adds the time spent inside to `section`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.seconds[section] = self.seconds.get(section, 0.0) + elapsed

    def share(self, *sections: str) -> float:
        """Returns the share of all counted time that the sections took; 0 at first."""
        total = sum(self.seconds.values())
        return sum(self.seconds.get(name, 0.0) for name in sections) / total if total else 0.0

    def summary(self) -> str:
        """Returns the shares of all sections in one line, the largest first."""
        ordered = sorted(self.seconds, key=self.seconds.__getitem__, reverse=True)
        return ", ".join(f"{name} {self.share(name):.0%}" for name in ordered)
