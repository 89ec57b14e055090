"""How an episode stands, what was hit, and what a step is worth."""

from enum import IntEnum

from flowrep.palette import CATEGORY_ID


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


NOTHING_HIT = 255
"""The code of `hit` where nothing was hit: no class has this id."""

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
    """Returns what the TensorDict carries for what was hit: its class id, `NOTHING_HIT` for "".

    >>> hit_code("pedestrian"), hit_code("")
    (4, 255)
    """
    return CATEGORY_ID[category] if category else NOTHING_HIT


def hit_name(code: int) -> str:
    """Returns the category that `hit_code` gave this code, "" for nothing.

    >>> hit_name(4), hit_name(255)
    ('pedestrian', '')
    """
    return "" if code == NOTHING_HIT else _CATEGORIES[code]
