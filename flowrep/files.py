"""Files that are written whole or not at all, and never through a link."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from glob import escape
from itertools import count
from pathlib import Path
from typing import IO, Any

_REFUSED = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES)


def replace_file(path: Path, write: Callable[[Path], Any]) -> None:
    """Calls `write` with another path, and renames the file to `path` once it is on disk.

    If that is interrupted, the previous file stays. An OSError names `path`.
    """
    _replace(path.parent, [path.name], lambda partial: write(partial / path.name))


def replace_text(path: Path, text: str) -> None:
    """Replaces a file by one of this text, in UTF-8."""
    replace_file(path, lambda partial: partial.write_text(text, encoding="utf-8"))


def replace_files(folder: Path, files: Mapping[str, bytes], *, as_one: bool = False) -> None:
    """Replaces files of a folder by these, given by name, once all are on disk.

    They are renamed in their order. With `as_one`, old and new files are never mixed: the old ones
    are removed first, beginning with the last of `files`, so if that one is there, all are.
    """

    def write(partial: Path) -> None:
        for name, data in files.items():
            (partial / name).write_bytes(data)

    _replace(folder, list(files), write, as_one)


def _replace(
    folder: Path, names: Sequence[str], write: Callable[[Path], Any], as_one: bool = False
) -> None:
    # In a new folder no name is a link, and whatever writers leave beside their file goes with it.
    partial = folder / f".{names[-1]}.{secrets.token_hex(4)}.partial"
    with naming(folder if names[1:] else folder / names[0]):
        for left in folder.glob(f".{escape(names[-1])}.*partial"):  # of writers that were killed
            shutil.rmtree(left, ignore_errors=True)
        try:
            partial.mkdir()
            write(partial)
            mode = partial.stat().st_mode & 0o666  # as of any new file; some writers set another
            for name in names:
                (partial / name).chmod(mode)
                _flush(partial / name)
            for name in reversed(names) if as_one else ():
                (folder / name).unlink(missing_ok=True)
            for name in names:
                _rename(partial / name, folder / name)
            _flush(folder)
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def _rename(file: Path, path: Path) -> None:
    os.replace(file, path)


def _flush(path: Path) -> None:
    """Waits until a file's contents, or a folder's entries, are on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def open_to_append(path: Path) -> IO[bytes]:
    """Opens or creates a file to append bytes without a buffer; a link is refused."""
    return open(str(path), "ab", buffering=0, opener=_open_no_link)


def _open_no_link(path: str, flags: int) -> int:
    try:
        # Not blocking, as a named pipe would wait for a reader.
        return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        what = "it is a link, and flowrep doesn't write through links: replace it by the file"
        raise OSError(errno.ELOOP, what, path) from None


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


def set_aside(path: Path, problem: object) -> None:
    """Renames a damaged file, so that a new one can be written, and prints a warning."""
    names = (path.with_name(f"{path.stem}.damaged{n}{path.suffix}") for n in count(1))
    other = next(name for name in names if not os.path.lexists(name))
    path.rename(other)
    what = " ".join(str(problem).split())
    print(f"warning: {path} is damaged ({what}); it is {other.name} now", file=sys.stderr)
