"""Files are written whole or not at all, under no name that somebody else chose."""

import errno
import os
import stat

import pytest

from flowrep import files
from flowrep.files import (
    append_rows,
    open_to_append,
    read_rows,
    replace_file,
    replace_text,
    write_rows,
)


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "folder"
    path.mkdir()
    return path


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def fails(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize(
    ("number", "has_remedy"), [(errno.ENOSPC, True), (errno.EACCES, True), (errno.ENOENT, False)]
)
def test_the_remedy_is_named_once_where_there_is_one(folder, number, has_remedy):
    with (
        pytest.raises(OSError, match=r"outer") as caught,
        files.naming(folder / "outer"),
        files.naming(folder / "inner"),
    ):
        raise OSError(number, os.strerror(number))
    assert caught.value.errno == number
    assert str(caught.value).count("free some space") == has_remedy


def test_a_replaced_file_is_like_any_new_one(folder):
    path = folder / "a.txt"
    path.write_text("old")
    path.chmod(0o600)
    umask = os.umask(0o027)
    try:
        replace_text(path, "é")
        with path.with_name("b.txt").open("w") as other:
            assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(
                os.fstat(other.fileno()).st_mode
            )
    finally:
        os.umask(umask)
    assert path.read_bytes() == "é".encode()


@pytest.mark.parametrize("step", ["write", "_flush", "os.replace"])
def test_whatever_fails_the_file_is_the_old_one_and_the_error_names_it(folder, monkeypatch, step):
    path = folder / "a.txt"
    path.write_text("old")
    if step != "write":
        monkeypatch.setattr(f"flowrep.files.{step}", fails)

    def write():
        with replace_file(path) as partial:
            partial.write_text("half")
            if step == "write":
                fails()

    with pytest.raises(OSError, match=r"a\.txt'$") as caught:
        write()
    assert caught.value.errno == errno.ENOSPC
    assert (names(folder), path.read_text()) == (["a.txt"], "old")


def test_a_file_is_on_disk_before_it_has_its_name_and_the_name_is_on_disk_too(folder, monkeypatch):
    order = []
    monkeypatch.setattr(
        os, "fsync", lambda file: order.append(os.readlink(f"/proc/self/fd/{file}"))
    )
    rename = os.replace
    monkeypatch.setattr(os, "replace", lambda *names: (order.append("renamed"), rename(*names)))
    replace_text(folder / "a.txt", "new")
    partial, renamed, last = order
    assert partial.endswith("/a.txt")
    assert (renamed, last) == ("renamed", str(folder))


def test_links_are_replaced_and_not_followed(folder, victim):
    (folder / "a.txt").symlink_to(victim)
    for name in (".a.txt.tmp", "a.tmp", "a.tmp.txt", ".a.txt.partial", ".a.txt.0.partial"):
        (folder / name).symlink_to(victim.parent)  # whatever a temporary file may be called
    replace_text(folder / "a.txt", "new")
    assert not (folder / "a.txt").is_symlink()
    assert (folder / "a.txt").read_text() == "new"


def test_nothing_is_appended_through_a_link_or_to_a_pipe(folder, victim):
    (folder / "a.csv").symlink_to(victim)
    (folder / "b.csv").symlink_to(victim.with_name("new"))
    os.mkfifo(folder / "c.csv")
    for name in ("a.csv", "b.csv", "c.csv"):
        with pytest.raises(OSError, match=name):
            open_to_append(folder / name)


def test_a_folder_that_is_a_link_to_another_disk_is_used(folder, tmp_path):
    there = tmp_path / "other"
    there.mkdir()
    (folder / "link").symlink_to(there)
    replace_text(folder / "link" / "a.txt", "new")
    assert names(there) == ["a.txt"]


# Tables.


def test_rows_come_back_as_text(tmp_path):
    table = tmp_path / "t.csv"
    append_rows(table, [{"a": 1, "b": "x, y"}])
    append_rows(table, [{"a": 2, "b": 'with "quotes"\nand a line'}])
    assert read_rows(table) == [
        {"a": "1", "b": "x, y"},
        {"a": "2", "b": 'with "quotes"\nand a line'},
    ]
    assert read_rows(tmp_path / "none.csv") == []


@pytest.mark.parametrize("lost", [1, 3, 6])
def test_half_a_last_line_is_left_out(tmp_path, lost):
    table = tmp_path / "t.csv"
    append_rows(table, [{"a": 1, "b": 2}, {"a": 123, "b": 456}])
    table.write_bytes(table.read_bytes()[:-lost])
    assert read_rows(table) == [{"a": "1", "b": "2"}]


def test_a_table_is_replaced_as_a_whole(tmp_path):
    table = tmp_path / "t.csv"
    write_rows(table, [{"a": 1}, {"a": 2}])
    write_rows(table, [{"a": 3}])
    assert read_rows(table) == [{"a": "3"}]
    write_rows(table, [])
    assert list(tmp_path.iterdir()) == []


def test_a_cell_that_64_bits_do_not_hold_or_that_is_not_finite_is_named_with_its_row(tmp_path):
    path = tmp_path / "table.csv"
    for cell, check in (("9" * 26, files.whole_number), ("1e999", files.finite_number)):
        path.write_text(f"frames\n1\n{cell}\n")
        with pytest.raises(files.TableError, match=f"frames is '{cell}' in row 2"):
            files.read_rows(path, ["frames"], {"frames": check})
