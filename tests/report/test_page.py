"""A whole report: the command, its page and its files."""

import re
from itertools import product

import pytest

from flowrep.report.__main__ import ReportConfig, report
from flowrep.report.figures import draw_bars, encoded
from flowrep.report.runs import Condition, grid_of, read_run
from tests.report.folders import config_of, letters, rows_of, run_in, write_run
from tests.running import run_here


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Both of the paper's experiments in two scenes, one cell empty, one run damaged."""
    folder = tmp_path_factory.mktemp("outputs") / "sweep"
    stacks = ("ego", "raw", "ego+obj", "seg2")
    cells = [(scene, stack) for scene in ("straight_road", "s_turn") for stack in stacks]
    cells.remove(("s_turn", "raw"))
    for (scene, stack), seed in product(cells, range(2)):
        config = config_of(scene, stack, seed, experiment="flow_composition")
        rows = []
        for speed in ("low", "normal", "high"):
            rows += rows_of(config, letters(2 + len(stack) - seed, rest="o"), speed=speed)
            rows += rows_of(config, letters(1), speed=speed, policy="never_turn")
        rows += rows_of(config, letters(1), fps=6.0)
        metrics = [{"frames": f, "success": f / 2000} for f in (250, 500, 1000)]
        write_run(folder / f"{scene}_{stack}_s{seed}", config, rows, metrics)
    write_run(folder / "damaged", config_of(seed=9), []).joinpath("config.yaml").write_text("a: [")
    return folder


@pytest.fixture(scope="module")
def page(sweep):
    return report(ReportConfig(run=[str(sweep)], output=None, policy="greedy"))


@pytest.mark.slow
def test_each_experiment_has_its_figure_and_tables_in_every_form(page):
    files = (path for path in page.parent.rglob("*") if path.is_file())
    found = {path.relative_to(page.parent).as_posix() for path in files}
    names = ("flow_composition", "complementary", "frame_rate", "learning_curves")
    drawn = {f"{name}/{name}.{kind}" for name in names for kind in ("png", "pdf")}
    tables = {f"{name}/{name}_success" for name in names[:3]} | {"failure_causes/failure_causes"}
    tables |= {f"{name}/{name}_differences" for name in names[:2]}
    assert found == drawn | {f"{name}.csv" for name in tables} | {"index.html", "files.txt"}


@pytest.mark.slow
def test_the_page_holds_all_it_shows_and_says_what_is_missing_and_wrong(page):
    text = page.read_text(encoding="utf-8")
    assert '<td class="missing">missing</td>' in text
    assert "damaged/config.yaml" in text
    (heading,) = re.findall(r"<h1>(.*)</h1>", text)
    assert "Straight Road" in heading
    assert "S-Turn" in heading
    assert len(re.findall(r"<tr><td[^>]*>[^<]*_s[01]</td>", text)) == 14  # the runs' table
    sources = set(re.findall(r'(?:src|srcset|href)="(data:[a-z+/0-9]+|#|[^"]*)', text))
    assert sources == {"data:image/svg+xml", "#"}  # nothing is fetched
    for anchor in re.findall(r'href="#([^"]+)"', text):
        assert f'id="{anchor}"' in text


def test_a_figure_drawn_again_is_the_same_byte_for_byte(tmp_path):
    run = run_in(tmp_path, "run", 3)
    conditions = [Condition("greedy", "normal", 12.0)]
    series = {"ego+obj": [read_run(run)], "ego+obj+seg2": []}
    grid = grid_of("straight_road", series, conditions)
    first, second = draw_bars([grid]), draw_bars([grid])
    for kind in ("svg", "pdf"):
        assert encoded(first, kind) == encoded(second, kind)


# The command.


@pytest.mark.parametrize("damaged", [False, True])
def test_nothing_to_report_on_is_one_line(tmp_path, monkeypatch, capsys, damaged):
    if damaged:
        (run_in(tmp_path, "run") / "config.yaml").write_text("[")
    assert run_here(monkeypatch, ["python", "flowrep.report", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1
    assert (f"{tmp_path}/run/config.yaml" in said.out) == damaged


def test_the_command_prints_results_and_the_path_of_the_page(tmp_path, monkeypatch, capsys):
    run = run_in(tmp_path, "run", "soccc")
    line = ["python", "flowrep.report", str(run), f"output={tmp_path / 'out'}"]
    assert run_here(monkeypatch, line) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("ego+obj", "Straight Road"))
    assert "0.333 [0.048–2.326]" in said  # 1 out of bounds to 3 collisions; Wilson's of 1 of 4
    assert str(tmp_path / "out" / "index.html") in said
    assert (tmp_path / "out" / "index.html").is_file()


def test_a_link_in_a_runs_folder_leads_a_report_nowhere(tmp_path, victim, monkeypatch):
    run = run_in(tmp_path, "run")
    (run / "report").mkdir()
    (run / "report" / "index.html").symlink_to(victim)
    assert run_here(monkeypatch, ["python", "flowrep.report", f"run={run}"]) == 0
    assert "<html" in (run / "report" / "index.html").read_text()
