"""The commands' configs: their files, their schema (`schema`) and their command lines (`cli`)."""

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
