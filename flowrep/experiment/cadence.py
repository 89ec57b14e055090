"""Intervals in a training loop, as callable objects."""

from dataclasses import dataclass


@dataclass
class Every:
    """True once each time a step counter passes a multiple of `interval`.

    The counter may advance by more than one (vectorised environments); a multiple that was jumped
    over counts when it is passed. `interval=0` never fires.

    >>> should_log = Every(10)
    >>> [should_log(step) for step in (4, 8, 12, 16, 20, 24)]
    [False, False, True, False, True, False]
    """

    interval: int
    last: int = 0

    def __call__(self, step: int) -> bool:
        """Returns whether `step` passed a new multiple since the last call."""
        if not self.interval or step // self.interval <= self.last // self.interval:
            return False
        self.last = step
        return True
