"""Violations of a config's schema, as lines that a user can act on."""

import difflib
import reprlib
from collections.abc import Iterable, Sequence
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails, PydanticCustomError

EXPECTED = "expected"
"""Type of the errors of `flowrep.config.expectations`; their text says what is expected."""

RULE = "rule"
"""Type of the errors of rules between keys; their text is the whole line."""

UNKNOWN = "unknown"
"""Type of the errors of keys that a section does not have."""

ABSENT = "absent"
"""Type of the errors of keys that a section should have."""


class UsageError(Exception):
    """A mistake on the command line; the message is all that the user needs to read."""


def broken_rule(key: str, problem: str) -> PydanticCustomError:
    """Returns the error of a rule between several keys, for a section's validators to raise.

    Args:
        key: the key to change first, relative to the section, e.g. "batch_size"; "" is the section.
        problem: the text after the key in the line, e.g. "should be at most 5, not 6".
    """
    return PydanticCustomError(RULE, "{problem}", {"key": key, "problem": problem})


def lines_of(error: ValidationError) -> list[str]:
    """Returns one line for each violation."""
    return [_line(details) for details in error.errors(include_url=False)]


def shown(value: Any) -> str:
    """Returns a value as it is written in a config, shortened if it is long.

    >>> shown(None), shown(True), shown("low"), shown(0.5)
    ('null', 'true', "'low'", '0.5')
    """
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return reprlib.repr(value)


def closest(name: str, known: Sequence[str]) -> str:
    """Returns "did you mean" with the known name most similar to `name`, or an empty text.

    >>> closest("sed", ["speed", "seed"])
    " (did you mean 'seed'?)"
    """
    close = difflib.get_close_matches(name, known, n=1)
    return f" (did you mean '{close[0]}'?)" if close else ""


def _line(details: ErrorDetails) -> str:
    value, context = details["input"], details.get("ctx", {})
    path = list(_path(details["loc"]))
    if details["type"] == RULE:
        path += [context["key"]] if context["key"] else []
        return f"{'.'.join(path)} {context['problem']}".strip()
    if details["type"] == ABSENT:
        key = ".".join([*path, context["key"]])
        return f"'{key}' needs a value: {key}={context['example']}"
    key = ".".join(path)
    if details["type"] == UNKNOWN:
        where = f" of '{key}'" if key else ""
        return f"unknown key '{context['key']}'{where}{context['remedy']}"
    if details["type"] == EXPECTED:
        remedy = _remedy(key, value, details["msg"], context.get("names", "").split(", "))
        return f"{key} should be {details['msg']}, not {shown(value)}{remedy}"
    return f"{key}: {details['msg']}, not {shown(value)}"


def _path(location: Iterable[int | str]) -> Iterable[str]:
    """Yields the keys down to a value, without pydantic's marks of unions (`@...`)."""
    for part in location:
        if not (isinstance(part, str) and part.startswith("@")):
            yield str(part)


def _remedy(key: str, value: Any, expected: str, names: Sequence[str]) -> str:
    if expected.startswith("a list") and isinstance(value, str | int | float):
        return f"; write {key}=[{value}]"
    if isinstance(value, float) and "whole number" in expected and value.is_integer():
        return f"; write {int(value)}"
    for item in value if isinstance(value, list) else [value]:
        if isinstance(item, str) and item not in names:
            return closest(item, names)
    return ""
