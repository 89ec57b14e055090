"""The error of a user's mistake, and its list of choices; `config.cli` prints it as one line."""

from collections.abc import Iterable
from difflib import get_close_matches


class UsageError(ValueError):
    """A mistake of the user; the message is all that one needs to read."""


def closest_first(name: str, choices: Iterable[str]) -> str:
    """Returns choices as text, sorted, but those that look like a misspelt name first.

    >>> closest_first("strait_road", ["h_shaped_pathways", "s_turn", "straight_road"])
    'straight_road, h_shaped_pathways, s_turn'
    """
    there = sorted(choices)
    near = get_close_matches(name, there)
    return ", ".join([*near, *(choice for choice in there if choice not in near)])
