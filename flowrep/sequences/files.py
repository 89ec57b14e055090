"""Reads bytes, text and numbers from untrusted files, with limits and errors that name the file."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.frame import SequenceError

MAX_TEXT_BYTES = 64 * 2**20
MAX_FILE_BYTES = 512 * 2**20
_MAX_PATH = 1000


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """Returns a file's content.

    Raises:
        SequenceError: there is no such file, it is empty, or larger than `limit`.
    """
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise SequenceError(path, "is not a file")
        if size > limit:
            raise SequenceError(path, f"has {size:,} bytes, more than the {limit:,} expected here")
        data = path.read_bytes()
    except OSError as error:
        raise SequenceError(path, _reason(error)) from None
    if not data:
        raise SequenceError(path, "is empty")
    return data


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Returns the non-empty lines, each after its number; `#` starts a comment."""
    try:
        text = read_bytes(path, MAX_TEXT_BYTES).decode("utf-8")
    except UnicodeDecodeError:
        raise SequenceError(path, "is not text") from None
    lines = ((number, line.strip()) for number, line in enumerate(text.splitlines(), start=1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def read_table(path: Path, columns: Iterable[int], *, header: bool = False) -> NDArray[np.float64]:
    """Returns the numbers of a text file, one row per line, `[N, columns]`.

    Args:
        path: the file; numbers are separated by blanks or commas.
        columns: the permitted numbers of columns; every line has the same one.
        header: whether the first line has names.

    Raises:
        SequenceError: there are no numbers, or a line has another number of columns.
    """
    allowed = tuple(columns)
    rows: list[list[float]] = []
    for number, line in read_lines(path)[1 if header else 0 :]:
        row = [_number(path, number, word) for word in re.split(r"[\s,]+", line.strip(","))]
        wanted = (len(rows[0]),) if rows else allowed
        if len(row) not in wanted:
            expected = " or ".join(map(str, wanted))
            raise SequenceError(path, f"line {number} has {len(row)} numbers, expected {expected}")
        rows.append(row)
    if not rows:
        raise SequenceError(path, "holds no numbers")
    return np.array(rows, dtype=np.float64)


def read_matrix(path: Path, rows: int, columns: int) -> NDArray[np.float64]:
    """Returns the one matrix that a text file holds."""
    table = read_table(path, [columns])
    if len(table) != rows:
        raise SequenceError(path, f"has {len(table)} lines, expected {rows}")
    return table


def read_json(path: Path) -> dict[str, Any]:
    """Returns the object that a JSON file holds."""
    try:
        value = json.loads(read_bytes(path, MAX_TEXT_BYTES))
    except (ValueError, RecursionError) as error:
        raise SequenceError(path, f"is not JSON ({str(error).splitlines()[0]})") from None
    if not isinstance(value, dict):
        raise SequenceError(path, f"should be a JSON object, not {type(value).__name__}")
    return value


def list_files(folder: Path, suffixes: Iterable[str], prefix: str = "") -> list[Path]:
    """Returns a folder's files with one of the suffixes, sorted by number, then by name.

    Raises:
        SequenceError: no such folder, no such file in it, or two that differ in the suffix alone.
    """
    suffixes = tuple(suffixes)
    try:
        found = [
            path
            for path in folder.iterdir()
            if path.suffix.lower() in suffixes and path.name.startswith(prefix)
        ]
    except OSError as error:
        raise SequenceError(folder, _reason(error, "folder")) from None
    if not found:
        raise SequenceError(folder, f"holds no {prefix}*{' or '.join(suffixes)} file")
    found.sort(key=_natural)
    by_stem: dict[str, Path] = {}
    for path in found:
        if (first := by_stem.setdefault(path.stem, path)) is not path:
            raise SequenceError(path, f"belongs to the same frame as {first.name}; remove one")
    return found


def path_inside(folder: Path, relative: str, index: Path) -> Path:
    """Returns the path that an index file names.

    Raises:
        SequenceError: it leads out of the folder, or is too long for a path.
    """
    if len(relative) > _MAX_PATH:
        raise SequenceError(index, f"names a file by {len(relative):,} characters")
    parts = PurePosixPath(relative.replace("\\", "/"))
    if parts.is_absolute() or ".." in parts.parts or "\0" in relative or ":" in relative:
        raise SequenceError(index, f"names {relative!r}, which lies outside of the folder")
    return folder / parts


def _natural(path: Path) -> tuple[list[tuple[int, int | str]], str]:
    pieces = re.split(r"(\d+)", path.name)
    return [(0, int(p)) if p.isdecimal() and p.isascii() else (1, p) for p in pieces], path.name


def _number(path: Path, line: int, word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise SequenceError(path, f"line {line}: {word[:40]!r} is not a number") from None


def finite_number(path: Path, name: str, value: Any) -> float:
    """Returns a file's value if it is a finite number; otherwise raises SequenceError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SequenceError(path, f"{name} should be a number, not {str(value)[:40]!r}")
    return float(value)


def _reason(error: OSError, what: str = "file") -> str:
    known = {FileNotFoundError: f"no such {what}", NotADirectoryError: "is not a folder"}
    return known.get(type(error), (error.strerror or str(error)).lower())
