"""The commands' configs: their files, their schema (`schema`) and their command lines (`cli`)."""

from pathlib import Path
from typing import Any

import yaml

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


def read_config(path: Path) -> dict[str, Any]:
    """Returns the config that a run stored, as plain data: no text in it is resolved or called.

    Raises:
        UsageError: it can't be read; the message names the file.
    """
    problem: object = "it holds no config"
    try:
        config = yaml.load(path.read_text(encoding="utf-8"), _Loader)
        if isinstance(config, dict):
            return config
    except yaml.YAMLError as error:
        problem = error
    except (ValueError, KeyError, AttributeError, RecursionError) as error:
        problem = f"{type(error).__name__}: {error}"  # of PyYAML, at values of another tag
    raise UsageError(f"{path} can't be read: {' '.join(str(problem).split())}; restore the file")


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader without aliases, by which few lines can stand for gigabytes."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.composer.ComposerError(None, None, "no run writes an alias", mark)
        return super().compose_node(parent, index)
