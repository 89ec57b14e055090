import pytest

from flowrep.tables import append_rows, is_whole, read_rows, write_rows


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
    assert is_whole(table)
    table.write_bytes(table.read_bytes()[:-lost])
    assert not is_whole(table)
    assert read_rows(table) == [{"a": "1", "b": "2"}]


def test_a_table_is_replaced_as_a_whole(tmp_path):
    table = tmp_path / "t.csv"
    write_rows(table, [{"a": 1}, {"a": 2}])
    write_rows(table, [{"a": 3}])
    assert read_rows(table) == [{"a": "3"}]
    write_rows(table, [])
    assert list(tmp_path.iterdir()) == []
