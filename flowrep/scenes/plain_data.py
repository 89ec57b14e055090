"""Reads any YAML into plain data, in bounded time and memory."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

MOST_BYTES = 100_000
_MOST_VALUES = 50_000
_MOST_DEEP = 20
_LONGEST_TEXT = 1_000
_LARGEST_WHOLE = 2**53  # up to here every whole number is exact as a float


class PlainDataError(ValueError):
    """Input that is not plain data; the message states the problem, `key` its location."""

    def __init__(self, problem: str, key: str = "") -> None:
        """Stores the problem and its key."""
        super().__init__(problem)
        self.key = key


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, without deep nesting, duplicate keys and unbounded merges."""

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        self._merged = self._depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        if self._depth > _MOST_DEEP:
            raise PlainDataError("is nested too deep")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        names = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for name, count in names.items():
            if count > 1:
                self._refuse(f"the key {name!r} is given twice", node)
        return node

    def flatten_mapping(self, node: Any) -> None:
        super().flatten_mapping(node)
        self._merged += len(node.value)
        if self._merged > _MOST_VALUES:
            self._refuse("its merge keys make it too large", node)

    def _refuse(self, problem: str, node: Any) -> None:
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


def read_yaml(path: Path) -> Any:
    """Returns the content of a YAML file.

    Raises:
        PlainDataError: the file can't be read, is too large, or is not YAML.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise PlainDataError(f"is larger than {MOST_BYTES // 1000} kB")
        return yaml.load(content.decode("utf-8-sig"), _Loader)
    except OSError as error:
        raise PlainDataError(f"can't be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise PlainDataError("is not text in UTF-8") from error
    except PlainDataError:
        raise
    except yaml.YAMLError as error:
        raise PlainDataError(f"is not YAML: {' '.join(str(error).split())}") from error
    except (ValueError, OverflowError, TypeError, AttributeError, KeyError, IndexError) as error:
        # PyYAML passes on Python's errors for values like 2001-99-99 or an empty !!int.
        problem = f"is not YAML: it holds an invalid value ({error})"
        raise PlainDataError(shortened(problem, 200)) from error


def plain(value: Any) -> Any:
    """Returns a value as dicts, lists, strings, numbers, booleans and None.

    Raises:
        PlainDataError: the value holds anything else, is nested too deep, or is too large.
    """
    return _Plain().convert(value, "", 0)


def shortened(text: str, most: int = 60) -> str:
    """Returns text on one line, cut to `most` characters."""
    line = " ".join(text.split())
    return line if len(line) <= most else f"{line[:most]}..."


class _Plain:
    def __init__(self) -> None:
        self.count = 0

    def convert(self, value: Any, key: str, depth: int) -> Any:
        self.count += 1
        if self.count > _MOST_VALUES:
            raise PlainDataError(f"holds more than {_MOST_VALUES} values", key)
        if depth > _MOST_DEEP:
            raise PlainDataError("is nested too deep", key)
        if isinstance(value, Mapping):
            return {
                self.key(name, key): self.convert(item, join(key, name), depth + 1)
                for name, item in value.items()
            }
        if isinstance(value, Sequence) and not isinstance(value, (str, bytes, bytearray)):
            items = enumerate(value)
            return [self.convert(item, f"{key}[{i}]", depth + 1) for i, item in items]
        return self.scalar(value, key)

    @staticmethod
    def key(name: Any, key: str) -> str:
        if not isinstance(name, str):
            raise PlainDataError(f"has the key {shortened(repr(name))}, which is not text", key)
        return name

    @staticmethod
    def scalar(value: Any, key: str) -> Any:
        if isinstance(value, str):
            if len(value) > _LONGEST_TEXT:
                raise PlainDataError(f"is a text of {len(value)} characters", key)
            return value
        if isinstance(value, int) and abs(value) > _LARGEST_WHOLE:
            raise PlainDataError("is too large a number", key)
        if value is None or isinstance(value, (bool, int, float)):
            return value
        raise PlainDataError(f"is a {type(value).__name__}, not text or a number", key)


def join(key: str, name: Any) -> str:
    """Returns the dotted key of a name below a key."""
    name = shortened(str(name))
    return f"{key}.{name}" if key else name
