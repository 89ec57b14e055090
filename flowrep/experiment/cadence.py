"""When things happen in a training loop, as objects whose names say what for."""

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
        """Says whether `step` passed a new multiple since the last call."""
        if not self.interval or step // self.interval <= self.last // self.interval:
            return False
        self.last = step
        return True


@dataclass
class UpdatesDue:
    """Counts the gradient updates that are due after each collected batch.

    Args:
        frames_per_update: environment steps for one update (the paper's "steps per update").
        learning_starts: frames that must be stored before the first update.

    >>> updates_due = UpdatesDue(frames_per_update=10, learning_starts=30)
    >>> [updates_due(frames) for frames in (8, 24, 40, 64)]
    [0, 0, 1, 2]
    """

    frames_per_update: int
    learning_starts: int
    done: int = 0

    def __call__(self, frames: int) -> int:
        """Returns how many updates to do now that `frames` have been stored in all."""
        total = max(0, frames - self.learning_starts) // self.frames_per_update
        due, self.done = total - self.done, total
        return due
