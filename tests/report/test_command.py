"""The command line: folders as they were typed, mistakes in one line."""

import sys

import pytest

pytest.importorskip("scipy", reason="reports are an extra")
pytest.importorskip("pybullet", reason="the schema reads the simulator's names")

from flowrep.report.__main__ import main, show
from flowrep.report.tables import Table
from tests.report.folders import config_of, rows_of, write_run


def ended(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["flowrep-report", *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        main()
    return caught.value.code, capsys.readouterr()


def test_a_folder_without_runs_is_one_line_and_no_traceback(tmp_path, monkeypatch, capsys):
    code, said = ended(monkeypatch, capsys, tmp_path)
    assert code == 2
    assert said.err.startswith(f"error: '{tmp_path}' holds no run")
    assert said.err.count("\n") == 1


def test_folders_that_are_all_damaged_are_lines(tmp_path, monkeypatch, capsys):
    run = write_run(tmp_path / "run", config_of(), rows_of(config_of(), "s"))
    (run / "config.yaml").write_text("[")
    code, said = ended(monkeypatch, capsys, tmp_path)
    assert code == 2
    assert said.out.startswith(f"left out: {run}/config.yaml")
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1


def test_what_was_found_is_printed_and_where_it_was_written(tmp_path, monkeypatch, capsys):
    run = write_run(tmp_path / "run", config_of(), rows_of(config_of(), "soccc"))
    monkeypatch.setattr("flowrep.report.__main__.write_files", lambda *_: [])
    monkeypatch.setattr(sys, "argv", ["flowrep-report", str(run), f"output={tmp_path / 'out'}"])
    main()
    said = capsys.readouterr().out
    assert "1 run, 1 of them finished, of 1 stack (ego+obj) in Straight Road" in said
    assert "0.333 [0.048–2.326]" in said  # 1 out of bounds to 3 collisions; Wilson's of 1 of 4
    assert said.endswith(f"page: {tmp_path / 'out' / 'index.html'}\n")


def test_a_tables_title_may_hold_brackets(capsys):
    show(Table("t", "", ("a column as wide as the title",), ()), "tau=[/red], scale=[1]")
    assert capsys.readouterr().out.split("\n")[0].strip() == "tau=[/red], scale=[1]"


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path, monkeypatch, capsys):
    run = write_run(tmp_path / "run", config_of(), rows_of(config_of(), "s"))
    (tmp_path / "taken").write_text("")
    monkeypatch.setattr("flowrep.report.__main__.render_page", lambda *_: pytest.fail("too late"))
    code, said = ended(monkeypatch, capsys, run, "resamples=5", f"output={tmp_path / 'taken'}")
    assert code == 2
    assert said.err.count("\n") == 1
    assert "taken" in said.err
