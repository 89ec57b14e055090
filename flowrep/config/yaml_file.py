"""Reads YAML, of `conf/` and of users: what is wrong with it is one line, with file and line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from flowrep.config.usage import UsageError

_OURS = Path(__file__).resolve().parents[1] / "conf"
# In a checkout it is a link to the one beside the package, for `pkg://flowrep.conf`; git makes none
# on Windows.
CONF_DIR = (_OURS if _OURS.is_dir() else _OURS.parents[1] / "conf").resolve()


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, except that a repeated key is an error; PyYAML takes the last one."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        names: list[Any] = []
        for key, _ in node.value:
            if key.value in names and key.tag != "tag:yaml.org,2002:merge":
                what = f"the key {key.value!r} is given twice"
                raise yaml.constructor.ConstructorError(None, None, what, key.start_mark)
            names.append(key.value)
        return super().construct_mapping(node, deep)


def read_yaml(path: str | Path) -> Any:
    """Returns the content of a YAML file.

    Raises:
        UsageError: it can't be read, in one line with the file and the line.
    """
    try:
        return yaml.load(Path(path).read_text(encoding="utf-8"), _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = "" if mark is None else f", line {mark.line + 1}"
        what = " ".join(filter(None, (error.problem, error.context)))
        raise UsageError(f"{path}{line}: {what}") from error
    except RecursionError as error:
        raise UsageError(f"{path}: is nested too deeply") from error
    # The last two are PyYAML's at `!!bool x` and `!!timestamp x`.
    except (OSError, ValueError, yaml.YAMLError, KeyError, AttributeError) as error:
        raise UsageError(f"{path}: can't be read: {' '.join(str(error).split())}") from error
