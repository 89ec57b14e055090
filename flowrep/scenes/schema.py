"""The schema of scene files: `Scene` and its parts, checked by pydantic, exported for editors."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError

from flowrep.scenes.plain_data import PlainDataError, join, plain, shortened
from flowrep.scenes.scene import Scene


class SceneError(ValueError):
    """An invalid scene; the message names the file, the key, the problem and the remedy."""

    def __init__(self, source: str, key: str, problem: str, remedy: str) -> None:
        """Composes the message from the location (`source`, `key`), the problem and the remedy."""
        super().__init__(f"{source}: {key or 'the scene'}: {problem}; {remedy}")


@cache
def _adapter() -> TypeAdapter[Scene]:
    return TypeAdapter(Scene)


def scene_from_data(data: Any, *, source: str) -> Scene:
    """Returns a scene from a mapping whose keys are exactly the fields of `Scene`.

    Args:
        data: nested mappings, lists and values.
        source: the file, for messages.

    Raises:
        SceneError: a key is unknown or missing, or a value has the wrong type or is out of range.
    """
    try:
        content = plain(data)
    except PlainDataError as error:
        raise SceneError(source, error.key, str(error), "write plain keys and values") from error
    except RecursionError as error:
        raise SceneError(source, "", "is nested too deep", "write plain keys") from error
    if not isinstance(content, Mapping):
        problem = f"expected a mapping, got {shortened(repr(content))}"
        raise SceneError(source, "", problem, "write a scene's keys")
    try:
        return _adapter().validate_python(content)
    except ValidationError as error:
        # A misspelt key is also reported as missing; report the misspelling first.
        told = sorted(error.errors(include_url=False), key=lambda each: each["type"] != _UNKNOWN)
        raise SceneError(source, *_told(told[0])) from error


def json_schema() -> str:
    """Returns the JSON schema of scene files, as text."""
    schema = _adapter().json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return json.dumps(schema, indent=1) + "\n"


_UNKNOWN = "unexpected_keyword_argument"
_OUR_WORDS = {
    "Value error, give": "give",
    "Input should be": "it should be",
    "Tuple should have": "it should have",
    "String should have": "it should have",
    " after validation": "",
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
    "a valid number": "a number",
    "a valid integer": "a whole number",
    "a valid tuple": "a list",
    "a valid dictionary": "a mapping",
    "a valid string": "text",
    "a valid boolean": "true or false",
}


def _told(error: Any) -> tuple[str, str, str]:
    """Returns the key, the problem and the remedy for a pydantic error."""
    *parents, last = error["loc"]
    key = ""
    for part in (*parents, last):
        key = f"{key}[{part}]" if isinstance(part, int) else join(key, part)
    kind, message = error["type"], error["msg"]
    if kind == _UNKNOWN:
        return key, "unknown key", f"the keys are: {', '.join(_keys_at(parents))}"
    if kind == "missing":
        what = "value" if isinstance(last, int) else "key"
        return key, f"missing {what}", "add it"
    problem = f"got {shortened(repr(error['input']))}"
    if kind == "string_pattern_mismatch":
        letters = "letters, digits, - and _" if key == "name" else "text with no space at its ends"
        return key, problem, f"give a name: {letters}"
    if kind == "dataclass_type":
        return key, problem, "it should be a mapping: write its keys"
    for theirs, ours in _OUR_WORDS.items():
        message = message.replace(theirs, ours)
    return key, problem, message


def _keys_at(location: Sequence[str | int]) -> list[str]:
    """Returns the keys of the part of a scene at a location."""
    part: Any = Scene
    for name in location:
        if isinstance(name, str):
            part = _dataclass_in(get_type_hints(part)[name])
    return [field.name for field in dataclasses.fields(part)]


def _dataclass_in(hint: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        return hint
    return next(filter(None, map(_dataclass_in, get_args(hint))), None)
