"""What a file may set that is not flowrep's: one of a `--config-dir`, perhaps of somebody else.

Hydra would take it for the user's word: a file in `scene/` could set `hydra.callbacks`, whose
`_target_` Hydra calls, and `${oc.env:TOKEN}` would end up in tables. So each file is looked at as
Hydra reads it, however it came to that file, before anything is merged or called.

- A file of a section's group (`scene`, `algorithm`, ...) sets keys of that section, and its
  `defaults` are files beside it.
- A file of `preset`, `experiment` or `debug`, and the config of a whole command, may set each key
  of the command, and choose from its groups.
- Of Hydra, a file sets nothing but `hydra.sweeper.params`, the runs of an experiment. How runs are
  launched and logged, and which folders they use, is typed.
- No file calls a resolver. A class that it names has to be typed, too: see `config.cli.checked`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partialmethod
from pathlib import Path
from typing import Any

from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import OmegaConf

from flowrep.config import CONF_DIR
from flowrep.config.usage import UsageError

_OURS = ("structured:", "pkg://hydra.conf", "pkg://hydra_plugins.", "pkg://flowrep.conf")
_WHOLE = ("preset", "experiment", "debug", "")  # "" is the folder itself, with commands' configs


@contextmanager
def checked_files() -> Iterator[None]:
    """Checks each file that Hydra reads in this context, unless it is flowrep's or a plugin's."""
    # Hydra looks for a file in several folders, and for others that this one names, so that only
    # the class that reads files knows which ones are used.
    kinds: list[Any] = Plugins.instance().discover(ConfigSource)
    readers = {source: source.load_config for source in kinds}
    for source, load in readers.items():
        source.load_config = partialmethod(_load, load)
    try:
        yield
    finally:
        for source, load in readers.items():
            source.load_config = load


def _load(source: ConfigSource, load: Any, config_path: str) -> ConfigResult:
    result: ConfigResult = load(source, config_path)
    if not source.full_path().startswith(_OURS) and Path(source.path).resolve() != CONF_DIR:
        name = f"{config_path.removesuffix('.yaml')}.yaml"
        ours = _as_dict(OmegaConf.load(CONF_DIR / name)) if (CONF_DIR / name).is_file() else {}
        content, group = _as_dict(result.config), config_path.rpartition("/")[0]
        # What is unchanged in a copy of conf/ is flowrep's.
        if content != ours and (does := _outside(group, result.header["package"], content, ours)):
            raise UsageError(
                f"{source.path}/{name} {does}; docs/configs.md says what a file of your own may "
                "set, all else is typed"
            )
    return result


def _as_dict(config: Any) -> dict[Any, Any]:
    plain = OmegaConf.to_container(config)
    return plain if isinstance(plain, dict) else {}


def _outside(group: str, package: str | None, content: dict[Any, Any], ours: dict[Any, Any]) -> str:
    """Returns what a file does outside of its group, "" if it stays in it."""
    section = group.partition("/")[0]  # a section's group may have folders
    package = package or group.replace("/", ".") or "_global_"
    is_whole = section in _WHOLE
    may_be = "_global_|(?!hydra$)[a-z_]+" if is_whole else rf"(?!hydra){re.escape(section)}(\.\w+)*"
    if not re.fullmatch(may_be, package):
        return f"sets keys of {package}, which is not its group"
    defaults = content.get("defaults")
    for entry in defaults if isinstance(defaults, list) else ():
        name = " ".join(map(str, entry)) if isinstance(entry, dict) else str(entry)
        is_beside = not isinstance(entry, dict) and not name.startswith("/")
        leaves = not (is_whole or is_beside) or "@" in name or "hydra" in re.split(r"\W", name)
        if leaves and entry not in ours.get("defaults", []):
            return f"has '{name}' in its defaults, which is not of its group"
    match content.get("hydra") or {}:
        case {"sweeper": {"params": runs, **other}, **more} if not {**other, **more}:
            for text in _texts(runs):
                if text.lstrip("+~").startswith("hydra") or "@" in text or "_target_" in text:
                    return f"has '{text}' in hydra.sweeper.params, which is no key of the command"
        case hydra if hydra != ours.get("hydra", {}):
            return "sets keys of hydra, other than an experiment's runs, hydra.sweeper.params"
    for text in _texts(content):
        if ":" in text.partition("${")[2]:
            return f"has '{text}', which calls a resolver"
    return ""


def _texts(value: Any) -> Iterator[str]:
    """Yields all keys and texts of nested data."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for each in [*value.items()] if isinstance(value, dict) else value:
            yield from _texts([*each] if isinstance(each, tuple) else each)
