"""How an episode stands, and what a step is worth."""

from enum import IntEnum


class Outcome(IntEnum):
    """How an episode stands; the code is what the TensorDict carries."""

    RUNNING = 0
    SUCCESS = 1
    COLLISION = 2
    OUT_OF_BOUNDS = 3
    TIMEOUT = 4

    @property
    def label(self) -> str:
        """The name in `info`, tables and files."""
        return self.name.lower()


STEP_REWARD = 0.01
END_REWARD = {
    Outcome.RUNNING: 0.0,
    Outcome.SUCCESS: 5.0,
    Outcome.COLLISION: -5.0,
    Outcome.OUT_OF_BOUNDS: -5.0,
    Outcome.TIMEOUT: -5.0,
}


def reward(outcome: Outcome) -> float:
    """Returns the reward of a step that leads to `outcome`.

    >>> reward(Outcome.SUCCESS), reward(Outcome.RUNNING)
    (5.01, 0.01)
    """
    return STEP_REWARD + END_REWARD[outcome]
