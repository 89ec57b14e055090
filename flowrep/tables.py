"""CSV tables that stay readable if a process is killed while it appends rows."""

import csv
import io
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from flowrep.files import naming, open_to_append, replace_file


class TableError(ValueError):
    """A table is damaged, or another program's."""


def read_rows(
    path: Path,
    columns: Iterable[str] = (),
    checks: Mapping[str, Callable[[str], Any]] | None = None,
) -> list[dict[str, str]]:
    """Returns a table's rows, none if there is no file; an incomplete last line is left out.

    Raises:
        TableError: one of `columns` is missing, as after a spreadsheet saved the table with
            semicolons; or a column's check raises a ValueError for a cell.
    """
    if not path.is_file():
        return []
    data = path.read_bytes()
    text = data[: data.rfind(b"\n") + 1].decode("utf-8-sig", errors="replace")
    table = csv.DictReader(io.StringIO(text, newline=""))
    try:
        rows = list(table)
    except csv.Error as error:
        raise TableError(f"{path} is no table: {error}; move it aside") from None
    missing = [name for name in columns if name not in (table.fieldnames or ())]
    if rows and (missing or any(None in row.values() or None in row for row in rows)):
        raise TableError(
            f"{path} lacks {', '.join(missing) or 'cells in a line'}: perhaps another program or "
            "version wrote it; move it aside, or export it again with commas"
        )
    for number, row in enumerate(rows, start=1):
        for name, check in (checks or {}).items():
            try:
                check(row[name])
            except ValueError:
                raise TableError(
                    f"{path}: {name} is {row[name]!r} in row {number}, which flowrep never writes: "
                    "restore the table, or move it aside"
                ) from None
    return rows


def is_whole(path: Path) -> bool:
    """Returns whether a table ends with a complete line, or does not exist."""
    return not path.is_file() or path.read_bytes().endswith(b"\n")


def write_rows(
    path: Path, rows: Iterable[Mapping[str, Any]], columns: Iterable[str] | None = None
) -> None:
    """Replaces a whole table, or leaves the old one; without rows, the file is removed."""
    if rows := list(rows):
        replace_file(path, partial(append_rows, rows=rows, columns=columns))
    else:
        path.unlink(missing_ok=True)


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
    # In one call, so that a process that is killed leaves all rows or none.
    with naming(path), open_to_append(path) as raw:
        data = text.getvalue().encode("utf-8")
        written = raw.write(data)
        while written < len(data):  # an almost full disk takes a part, and raises at the next call
            written += raw.write(data[written:])
