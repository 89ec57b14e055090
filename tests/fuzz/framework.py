"""Throws odd inputs at one part of flowrep after another; each has to be taken or refused well.

A part is a module beside this one that holds a `PART`. Every case is drawn from the seed, the
part's name and its own number alone, so that one that fails can be run again by itself.
"""

import random
import resource
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

SECONDS = 5.0
"""Of computing, for one input."""

MEMORY_BYTES = 1 << 30
"""On top of what is in use before an input."""


@dataclass(frozen=True)
class Part:
    """What is tried.

    Args:
        name: as on the command line.
        draw: makes an odd input.
        run: gives it to flowrep and returns in a word what came of it; it raises whatever is not
            meant to happen.
        setup: called once before the first input, to load what would else count as the input's.
    """

    name: str
    draw: Callable[[random.Random], Any]
    run: Callable[[Any], str]
    setup: Callable[[], None] = lambda: None


@dataclass
class Tally:
    """How often what came of inputs, and which of them failed."""

    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[tuple[int, str]] = field(default_factory=list)
    slowest: tuple[float, int] = (0.0, -1)


class TooSlowError(Exception):
    """An input took longer than its time."""


@contextmanager
def limits() -> Iterator[None]:
    """Bounds computing time and memory, where the platform can."""

    def stop(*_: Any) -> None:
        raise TooSlowError(f"more than {SECONDS:.0f} s")

    in_use = _address_space()
    before = signal.signal(signal.SIGPROF, stop)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (in_use + MEMORY_BYTES, hard))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGPROF, before)


def _address_space() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[0]) * resource.getpagesize()


def case(part: Part, seed: int, number: int) -> Any:
    """Returns one input."""
    return part.draw(random.Random(f"{part.name} {seed} {number}"))


def fuzz(part: Part, numbers: range, seed: int, progress: Callable[[int], Any] = id) -> Tally:
    """Runs a part on the inputs of these numbers."""
    tally = Tally()
    part.setup()
    for number in numbers:
        odd = case(part, seed, number)
        started = time.process_time()
        try:
            with limits():
                outcome = part.run(odd)
        except Exception as error:  # anything at all is a failure here
            outcome = f"FAILED: {type(error).__name__}"
            tally.failures.append((number, "".join(traceback.format_exception(error, limit=-4))))
        tally.outcomes[outcome] += 1
        tally.slowest = max(tally.slowest, (time.process_time() - started, number))
        progress(number)
    return tally
