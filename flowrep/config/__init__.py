"""The commands' configs: their files, their schema (`schema`) and their command lines (`cli`)."""

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

_OURS = Path(__file__).resolve().parents[1] / "conf"
# In a checkout it is a link to the one beside the package, for `pkg://flowrep.conf`; git makes none
# on Windows.
CONF_DIR = (_OURS if _OURS.is_dir() else _OURS.parents[1] / "conf").resolve()


class UsageError(ValueError):
    """A mistake on the command line; the message is all that the user needs to read."""


def group_choices(group: str) -> list[str]:
    """Returns the names that a config group offers, sorted."""
    return sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))


def config_groups() -> list[str]:
    """Returns the names of flowrep's config groups, sorted: the folders of conf/ except Hydra's."""
    folders = (path for path in CONF_DIR.iterdir() if path.is_dir())
    return sorted(path.name for path in folders if path.name not in ("hydra", "__pycache__"))


def closest_first(name: str, choices: Iterable[str]) -> str:
    """Returns choices as text, sorted, but those that look like a misspelt name first.

    >>> closest_first("strait_road", ["h_shaped_pathways", "s_turn", "straight_road"])
    'straight_road, h_shaped_pathways, s_turn'
    """
    there = sorted(choices)
    near = get_close_matches(name, there)
    return ", ".join([*near, *(choice for choice in there if choice not in near)])
