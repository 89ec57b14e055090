"""Files that are written whole or not at all and never through a link, and tables in them."""

from __future__ import annotations

import csv
import errno
import io
import math
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from glob import escape
from pathlib import Path
from typing import Any

_REFUSED = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES)


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """Yields another path to write to, and renames that file to `path` once it is on disk.

    If that is interrupted, the previous file stays. A link is replaced. An OSError names `path`.
    """
    # In a new folder no name is a link, and whatever writers leave beside their file goes with it.
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    with naming(path):
        for left in path.parent.glob(f".{escape(path.name)}.*partial"):  # of killed writers
            shutil.rmtree(left, ignore_errors=True)
        try:
            partial.mkdir()
            yield partial / path.name
            # As of any new file; some writers set another mode.
            (partial / path.name).chmod(partial.stat().st_mode & 0o666)
            _flush(partial / path.name)
            os.replace(partial / path.name, path)
            _flush(path.parent)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def replace_bytes(path: Path, data: bytes) -> None:
    """Replaces a file by one with these contents."""
    with replace_file(path) as partial:
        partial.write_bytes(data)


def replace_text(path: Path, text: str) -> None:
    """Replaces a file by one of this text, in UTF-8."""
    replace_bytes(path, text.encode("utf-8"))


def _flush(path: Path) -> None:
    """Waits until a file's contents, or a folder's entries, are on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refuse_link(path: Path) -> Path:
    """Returns the path of a file or folder to write to, in a folder that may be a stranger's."""
    if path.is_symlink():
        raise _is_link(path)
    return path


def _is_link(path: str | Path) -> OSError:
    what = "it is a link, and flowrep doesn't write through links: replace it by what it points to"
    return OSError(errno.ELOOP, what, str(path))


def open_to_append(path: Path) -> io.FileIO:
    """Opens or creates a file to append bytes without a buffer; a link is refused."""
    return io.FileIO(str(path), "ab", opener=_open_no_link)


def _open_no_link(path: str, flags: int) -> int:
    try:
        # Not blocking, as a named pipe would wait for a reader.
        return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except OSError as error:
        raise (_is_link(path) if error.errno == errno.ELOOP else error) from None


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Makes OSErrors name this file (that of a full disk names none) and what to do about it."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        problem = error.strerror
        if error.errno in _REFUSED:  # anew, as another `naming` inside may have added the remedy
            problem = f"{os.strerror(error.errno)}; free some space or make the folder writable"
        raise OSError(error.errno, problem, str(path)) from error


# Tables (CSV) that stay readable if a process is killed while it appends rows.


class TableError(ValueError):
    """A table is damaged, or another program's."""


def whole_number(cell: str) -> int:
    """Returns a cell's whole number; raises ValueError unless 64 bits hold it, as numpy's do."""
    value = int(cell)
    if abs(value) >= 2**63:
        raise ValueError(f"{cell} has more than 64 bits")
    return value


def finite_number(cell: str) -> float:
    """Returns a cell's number; raises ValueError for inf and nan."""
    if not math.isfinite(value := float(cell)):
        raise ValueError(f"{cell} is not finite")
    return value


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


def write_rows(
    path: Path, rows: Iterable[Mapping[str, Any]], columns: Iterable[str] | None = None
) -> None:
    """Replaces a whole table, or leaves the old one; without rows, the file is removed."""
    if rows := list(rows):
        with replace_file(path) as partial:
            append_rows(partial, rows, columns)
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
    # The buffer passes all rows on in one call: a process that is killed leaves all or none. An
    # almost full disk takes a part of them, which closing the buffer notices.
    with naming(path), io.BufferedWriter(open_to_append(path)) as file:
        file.write(text.getvalue().encode("utf-8"))
