"""CSV tables that are appended to, and stay readable when a writer was killed on the way."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


def read_rows(path: Path) -> list[dict[str, str]]:
    """Returns a table's rows, none where there is no file; half a last line is left out."""
    if not path.is_file():
        return []
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1].decode("utf-8")
    return list(csv.DictReader(io.StringIO(whole, newline="")))


def is_whole(path: Path) -> bool:
    """Says whether a table ends with a whole line; one that does not exist lacks nothing."""
    return not path.is_file() or path.read_bytes().endswith(b"\n")


def write_rows(
    path: Path, rows: Iterable[Mapping[str, Any]], columns: Iterable[str] | None = None
) -> None:
    """Replaces a table as a whole; without rows, there is none."""
    rows = list(rows)
    if not rows:
        path.unlink(missing_ok=True)
        return
    fresh = path.with_suffix(".tmp")
    fresh.unlink(missing_ok=True)
    append_rows(fresh, rows, columns)
    fresh.replace(path)


def append_rows(
    path: Path, rows: Iterable[Mapping[str, Any]], columns: Iterable[str] | None = None
) -> None:
    """Appends rows to a table, writing its header first where the file is new.

    All go to the file in one call, so that a process that is killed leaves all of them or none.

    Raises:
        ValueError: a row's columns are not those of the table.
    """
    rows = list(rows)
    if not rows:
        return
    is_new = not path.is_file() or path.stat().st_size == 0
    if is_new:
        names = list(columns or rows[0])
    else:
        with path.open(newline="", encoding="utf-8") as file:
            names = next(csv.reader(file))
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, names)
    if is_new:
        writer.writeheader()
    writer.writerows(rows)
    with path.open("ab", buffering=0) as raw:
        data = text.getvalue().encode("utf-8")
        written = raw.write(data)
        while written < len(data):  # a disk that is nearly full takes a part, then says so
            written += raw.write(data[written:])


def add_columns(path: Path, columns: Sequence[str]) -> None:
    """Rewrites a table that lacks some of the columns with all of them, in their order.

    What the older table did not say stays empty.
    """
    rows = read_rows(path)
    if rows and not set(columns) <= set(rows[0]):
        write_rows(path, [dict.fromkeys(columns, "") | row for row in rows], columns)
