"""CSV tables that rows are appended to, readable even after a writer was killed."""

import csv
import io
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any


class TableError(ValueError):
    """A table is not what was written."""


def read_rows(path: Path, columns: Iterable[str] = ()) -> list[dict[str, str]]:
    """Returns a table's rows, none if there is no file; an incomplete last line is left out.

    A table without one of `columns` is refused, as after a spreadsheet saved it with semicolons.
    """
    if not path.is_file():
        return []
    data = path.read_bytes()
    text = data[: data.rfind(b"\n") + 1].decode("utf-8-sig", errors="replace")
    table = csv.DictReader(io.StringIO(text, newline=""))
    rows = list(table)
    missing = [name for name in columns if name not in (table.fieldnames or ())]
    if rows and (missing or any(None in row.values() or None in row for row in rows)):
        raise TableError(
            f"{path} lacks {', '.join(missing) or 'cells in a line'}: perhaps another program or "
            "version wrote it; move it aside, or export it again with commas"
        )
    return rows


def is_whole(path: Path) -> bool:
    """Returns whether a table ends with a complete line, or does not exist."""
    return not path.is_file() or path.read_bytes().endswith(b"\n")


def write_rows(
    path: Path, rows: Iterable[Mapping[str, Any]], columns: Iterable[str] | None = None
) -> None:
    """Replaces a whole table, or leaves the old one; without rows, the file is removed."""
    rows = list(rows)
    if not rows:
        path.unlink(missing_ok=True)
        return
    fresh = path.with_suffix(".tmp")
    fresh.unlink(missing_ok=True)
    try:
        append_rows(fresh, rows, columns)
        with fresh.open("rb") as file:
            os.fsync(file.fileno())
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)


def append_rows(
    path: Path, rows: Iterable[Mapping[str, Any]], columns: Iterable[str] | None = None
) -> None:
    """Appends rows to a table; a new one gets a header."""
    rows = list(rows)
    if not rows:
        return
    is_new = not path.is_file() or path.stat().st_size == 0
    if is_new:
        names = list(columns or rows[0])
    else:
        with path.open(newline="", encoding="utf-8-sig") as file:
            names = next(csv.reader(file))
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, names)
    if is_new:
        writer.writeheader()
    writer.writerows(rows)
    # in one call, so that a killed process leaves all of them or none
    with path.open("ab", buffering=0) as raw:
        data = text.getvalue().encode("utf-8")
        written = raw.write(data)
        while written < len(data):  # a nearly full disk takes a part, then raises
            written += raw.write(data[written:])
