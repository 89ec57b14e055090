"""Reads YAML, of `conf/` and of users: what is wrong with it is one line, with file and line."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import yaml

from flowrep.config.usage import UsageError

_OURS = Path(__file__).resolve().parents[1] / "conf"
# In a checkout it is a link to the one beside the package, for `pkg://flowrep.conf`; git makes none
# on Windows.
CONF_DIR = (_OURS if _OURS.is_dir() else _OURS.parents[1] / "conf").resolve()
MAX_NODES = 100_000
"""Most values of a file with its aliases expanded; flowrep's scenes have fewer than 1,000."""


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, except that a repeated key is an error; PyYAML takes the last one.

    It also refuses aliases that repeat each other: ten lines of ten aliases are 10¹⁰ values as soon
    as somebody copies what was read, and an alias within its own anchor is endless.
    """

    def get_single_node(self) -> Any:
        root = super().get_single_node()
        if root is not None:
            self._size(root, {})
        return root

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        names: list[Any] = []
        for key, _ in node.value:
            if key.value in names and key.tag != "tag:yaml.org,2002:merge":
                raise _problem(f"the key {key.value!r} is given twice", key)
            names.append(key.value)
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: Any) -> Any:
        number = super().construct_yaml_int(node)
        if abs(number) > sys.float_info.max:
            raise _problem("a number that no float holds", node)
        return number

    def _size(self, node: Any, sizes: dict[int, int | None]) -> int:
        """Returns how many values a node has with its aliases written out; `sizes` by identity."""
        if isinstance(node, yaml.ScalarNode):
            return 1
        if id(node) not in sizes:
            sizes[id(node)] = None  # being counted
            pairs = isinstance(node, yaml.MappingNode)
            parts = [part for pair in node.value for part in pair] if pairs else node.value
            sizes[id(node)] = 1 + sum(self._size(part, sizes) for part in parts)
        size = sizes[id(node)]
        if size is None:
            raise _problem("an alias is within its own anchor", node)
        if size > MAX_NODES:
            raise _problem(f"its aliases stand for more than {MAX_NODES:,} values", node)
        return size


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


def _problem(text: str, node: Any) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(None, None, text, node.start_mark)


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
