"""Quotes texts with any characters for Hydra and the shell."""

import re
import shlex
from collections.abc import Collection, Iterable
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ValueType
from hydra.errors import HydraException


def override(key: str, text: str) -> str:
    """Returns an override that sets `key` to exactly `text`, quoted only if necessary.

    >>> print(override("resume", "outputs/a"), override("resume", "a=b, c"))
    resume=outputs/a resume='a=b, c'
    """
    plain = f"{key}={text}"
    return plain if _reads_as(plain, text) else f"{key}={_quoted(text)}"


def shell_line(*words: str) -> str:
    """Returns words as a line to paste into a shell.

    >>> print(shell_line("flowrep-train", override("resume", "a=b")))
    flowrep-train 'resume='"'"'a=b'"'"''
    """
    return shlex.join(words)


def taken_as_typed(
    arguments: Iterable[str], keys: Collection[str], numbers: Collection[str] = ()
) -> list[str]:
    """Returns arguments with Hydra's quotes added to folders that were typed without them.

    A folder is quoted if it exists, or if Hydra would take its name for a number or the like.

    Args:
        arguments: the arguments of the command line.
        keys: the keys whose values are folders.
        numbers: those of them that may also be a number, as a camera's.
    """
    return [_as_typed(argument, keys, numbers) for argument in arguments]


def _as_typed(argument: str, keys: Collection[str], numbers: Collection[str]) -> str:
    key, _, text = argument.partition("=")
    if key not in keys or not text:
        return argument
    is_misread = key not in numbers and _reads_as_number(argument)
    return override(key, text) if is_misread or Path(text).exists() else argument


def _reads_as_number(line: str) -> bool:
    try:
        (parsed,) = OverridesParser.create().parse_overrides([line])
    except HydraException:
        return False
    is_single = parsed.value_type is ValueType.ELEMENT
    return is_single and isinstance(parsed.value(), int | float)  # a bool is an int


def _reads_as(line: str, text: str) -> bool:
    if "${" in text:  # OmegaConf would replace it
        return False
    try:
        (parsed,) = OverridesParser.create().parse_overrides([line])
    except HydraException:
        return False
    return parsed.value_type is ValueType.ELEMENT and parsed.value() == text


def _quoted(text: str) -> str:
    """Returns text in Hydra's single quotes, with OmegaConf's interpolations escaped."""
    text = re.sub(r"(\\*)\$\{", lambda found: found[1] * 2 + r"\${", text)
    # backslashes escape only before a quote, including the closing one
    text = re.sub(r"(\\*)(')", lambda found: found[1] * 2 + r"\'", text)
    text = re.sub(r"(\\+)$", lambda found: found[1] * 2, text)
    return f"'{text}'"
