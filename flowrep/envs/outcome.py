"""The outcome of an episode, the category hit, and the reward of a step."""

from enum import IntEnum

from flowrep.palette import CATEGORY_ID


class Outcome(IntEnum):
    """The state of an episode; the TensorDict holds its code."""

    RUNNING = 0
    SUCCESS = 1
    COLLISION = 2
    OUT_OF_BOUNDS = 3
    TIMEOUT = 4

    @property
    def label(self) -> str:
        """The name in `info`, tables and files."""
        return self.name.lower()


NOTHING_HIT = 255
"""The code of `hit` if nothing was hit; no class has this id."""

_CATEGORIES = tuple(CATEGORY_ID)

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


def hit_code(category: str) -> int:
    """Returns the TensorDict's code for the category hit: its class id, or `NOTHING_HIT` for "".

    >>> hit_code("pedestrian"), hit_code("")
    (4, 255)
    """
    return CATEGORY_ID[category] if category else NOTHING_HIT


def hit_name(code: int) -> str:
    """Returns the category of a code of `hit_code`, or "" for nothing.

    >>> hit_name(4), hit_name(255)
    ('pedestrian', '')
    """
    return "" if code == NOTHING_HIT else _CATEGORIES[code]
