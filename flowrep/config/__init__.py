"""How a command line and the files of conf/ become a config; how mistakes in them are reported."""

from flowrep.config.yaml_file import CONF_DIR

__all__ = ["CONF_DIR", "config_groups", "group_choices"]


def group_choices(group: str) -> list[str]:
    """Returns the names that a config group offers, sorted."""
    return sorted(path.stem for path in (CONF_DIR / group).glob("*.yaml"))


def config_groups() -> list[str]:
    """Returns the names of the config groups, sorted: the folders of conf/ with YAML files."""
    return sorted({path.parent.name for path in CONF_DIR.glob("*/*.yaml")})
