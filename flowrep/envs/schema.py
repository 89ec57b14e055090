"""Builds frozen dataclasses from plain data, refusing what their fields do not say."""

import dataclasses
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


class SceneError(ValueError):
    """A scene that cannot be: says in which file, at which key, what was expected, what to do."""

    def __init__(self, source: str, key: str, problem: str, remedy: str) -> None:
        """Composes the message from where (`source`, `key`), what, and what to do about it."""
        super().__init__(f"{source}: {key or 'the scene'}: {problem}; {remedy}")


def build(cls: type[T], data: Any, *, source: str, key: str = "") -> T:
    """Returns `cls` filled from a mapping whose keys are exactly its fields.

    Args:
        cls: a dataclass.
        data: the mapping, nested as the fields' types are.
        source: the file, for messages.
        key: where in the file the mapping lies, for messages.

    Raises:
        SceneError: a key is unknown or missing, or a value is of another type.
    """
    if not isinstance(data, Mapping):
        raise SceneError(source, key, f"expected a mapping, got {data!r}", "write its keys")
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for name in data:
        if name not in fields:
            known = ", ".join(fields)
            raise SceneError(source, _join(key, name), "unknown key", f"the keys are: {known}")
    hints = get_type_hints(cls)
    values = {}
    for name, f in fields.items():
        if name in data:
            values[name] = _convert(hints[name], data[name], source, _join(key, name))
        elif f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            kind = _describe(hints[name])
            raise SceneError(source, _join(key, name), "missing key", f"add it, {kind}")
    return cls(**values)


def _convert(hint: Any, value: Any, source: str, key: str) -> Any:
    origin, args = get_origin(hint), get_args(hint)
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type, hint), value, source=source, key=key)
    if origin in (Union, types.UnionType):
        if value is None:
            return None
        (inner,) = [arg for arg in args if arg is not type(None)]
        return _convert(inner, value, source, key)
    if origin is Literal:
        if value not in args:
            raise SceneError(source, key, f"unknown value {value!r}", f"choose one of {list(args)}")
        return value
    if origin is tuple:
        return _convert_tuple(hint, value, source, key)
    if origin is not None and issubclass(origin, Mapping):
        return _convert_mapping(args, value, source, key)
    return _convert_scalar(hint, value, source, key)


def _convert_tuple(hint: Any, value: Any, source: str, key: str) -> tuple:
    args = get_args(hint)
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise SceneError(source, key, f"expected a list, got {value!r}", _describe(hint))
    kinds = (args[0],) * len(value) if args[-1] is Ellipsis else args
    if len(kinds) != len(value):
        raise SceneError(
            source, key, f"expected {len(kinds)} values, got {len(value)}", _describe(hint)
        )
    return tuple(
        _convert(kind, item, source, f"{key}[{i}]")
        for i, (kind, item) in enumerate(zip(kinds, value))
    )


def _convert_mapping(args: tuple, value: Any, source: str, key: str) -> dict:
    if not isinstance(value, Mapping):
        raise SceneError(source, key, f"expected a mapping, got {value!r}", "write its keys")
    names = get_args(args[0])
    if set(value) != set(names):
        raise SceneError(source, key, f"has keys {sorted(value)}", f"give exactly {list(names)}")
    return {name: _convert(args[1], value[name], source, _join(key, name)) for name in names}


def _convert_scalar(hint: Any, value: Any, source: str, key: str) -> Any:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is float and is_number:
        return float(value)
    if isinstance(value, hint) and isinstance(value, bool) == (hint is bool):
        return value
    raise SceneError(source, key, f"got {value!r}", f"give {_describe(hint)}")


def _describe(hint: Any) -> str:
    if hint in (float, int):
        return "a number" if hint is float else "a whole number"
    if hint is str:
        return "a name"
    if hint is bool:
        return "true or false"
    if get_origin(hint) is tuple and get_args(hint)[-1] is not Ellipsis:
        return f"a list of {len(get_args(hint))} values"
    if get_origin(hint) is tuple:
        return "a list"
    return "a mapping" if dataclasses.is_dataclass(hint) else f"as {hint}"


def _join(key: str, name: Any) -> str:
    return f"{key}.{name}" if key else str(name)
