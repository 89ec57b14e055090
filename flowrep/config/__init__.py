"""The commands' configs: their files, their schema (`schema`) and their command lines (`cli`)."""

from flowrep.config.yaml_file import CONF_DIR

__all__ = ["CONF_DIR", "config_groups", "group_choices"]


def group_choices(group: str) -> list[str]:
    """Returns the names that a config group offers, sorted."""
    return sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))


def config_groups() -> list[str]:
    """Returns the names of flowrep's config groups, sorted: the folders of conf/ except Hydra's."""
    folders = (path for path in CONF_DIR.iterdir() if path.is_dir())
    return sorted(path.name for path in folders if path.name not in ("hydra", "__pycache__"))
