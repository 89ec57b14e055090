"""Configs of the commands: where their files are, their schema and their command lines.

`flowrep.config.schema` holds the models, `flowrep.config.cli` runs a command; docs/configs.md is
about both.
"""

from pathlib import Path

_IN_WHEEL = Path(__file__).resolve().parents[1] / "conf"
_IN_CHECKOUT = Path(__file__).resolve().parents[2] / "conf"

# In a checkout the package's `conf` is a link to the one beside it, for `pkg://flowrep.conf`.
CONF_DIR: Path = (_IN_WHEEL if _IN_WHEEL.is_dir() else _IN_CHECKOUT).resolve()


class UsageError(ValueError):
    """A mistake on the command line; the message is all that the user needs to read."""


def group_choices(group: str) -> list[str]:
    """Returns the names that a config group offers, sorted."""
    return sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))


def config_groups() -> list[str]:
    """Returns the names of flowrep's config groups, sorted: the folders of conf/ except Hydra's."""
    folders = (path for path in CONF_DIR.iterdir() if path.is_dir())
    return sorted(path.name for path in folders if path.name not in ("hydra", "__pycache__"))
