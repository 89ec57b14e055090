"""A whole report, from folders to a page in a browser."""

import json
import re
import shutil
import subprocess

import pytest

pytest.importorskip("scipy", reason="reports are an extra")
pytest.importorskip("jinja2", reason="reports are an extra")

from flowrep.config.schema import ReportConfig
from flowrep.report.__main__ import report
from flowrep.report.figures import draw_bars, save, svg
from flowrep.report.page import Drives, Picture, render_page
from flowrep.report.runs import Condition, grid_of
from flowrep.report.sections import COMPLEMENTARY, Report
from flowrep.report.statistics import Bootstrap
from flowrep.report.storage import read_run, write_archive
from tests.report.folders import config_of, letters, rows_of, write_run

pytestmark = pytest.mark.slow


def report_on(folder, output=None):
    numbers = {"resamples": 200, "trajectories": 0, "videos": 0}
    return report(ReportConfig(run=[str(folder)], output=output, policy="greedy", **numbers))


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """All of the paper's experiments in two scenes, one cell empty, one run damaged."""
    folder = tmp_path_factory.mktemp("outputs") / "sweep"
    stacks = ("ego", "raw", "obj", *COMPLEMENTARY.stacks)
    for scene in ("straight_road", "s_turn"):
        for place, stack in enumerate(stacks):
            for seed in range(2):
                if (scene, stack) == ("s_turn", "raw"):
                    continue
                config = config_of(scene, stack, seed, experiment="flow_composition")
                rows = []
                for speed in ("low", "normal", "high"):
                    rows += rows_of(config, letters(2 + (place + seed) % 6, rest="o"), speed=speed)
                    rows += rows_of(config, letters(1), speed=speed, policy="never_turn")
                for fps in (6.0, 9.0):
                    rows += rows_of(config, letters(1 + place % 7), fps=fps)
                rows += rows_of(config, letters(1), evaluation="training", frames=500)
                metrics = [{"frames": f, "success": f / 2000} for f in (250, 500, 1000)]
                write_run(folder / f"{scene}_{stack}_s{seed}", config, rows, metrics)
    write_run(folder / "damaged", config_of(seed=9), []).joinpath("config.yaml").write_text("a: [")
    return folder


@pytest.fixture(scope="module")
def page(sweep):
    return report_on(sweep)


def test_each_experiment_has_its_figure_and_tables_in_every_form(page):
    files = (path for path in page.parent.rglob("*") if path.is_file())
    found = {path.relative_to(page.parent).as_posix() for path in files}
    names = ("flow_composition", "complementary", "frame_rate", "learning_curves")
    drawn = {f"{name}/{name}.{kind}" for name in names for kind in ("png", "pdf", "tex")}
    tables = {f"{name}/{name}_success" for name in names[:3]} | {"failure_causes/failure_causes"}
    tables |= {f"{name}/{name}_differences" for name in names[:2]}
    written = {f"{name}.{kind}" for name in tables for kind in ("tex", "csv")}
    assert found == drawn | written | {"index.html"}


def test_names_are_drawn_as_they_are_and_nothing_is_written_elsewhere(tmp_path):
    for tau in (0.02, "[/red]"):
        config = config_of(r"$\foo$", "/../../evil+$x^$", algorithm__tau=tau)
        rows = rows_of(config, "sc") + rows_of(config, "sc", fps=6.0)
        metrics = [{"frames": 1000, "success": 0.5}]
        write_run(tmp_path / "runs" / f"run{len(str(tau))}", config, rows, metrics)
    page = report_on(tmp_path / "runs", str(tmp_path / "out" / "x"))
    text = page.read_text(encoding="utf-8")
    assert "Success over" in text
    assert "[/red]" in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "runs"]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["x"]


def test_packed_runs_have_the_same_tables(sweep, page, tmp_path):
    runs = [read_run(path.parent) for path in sorted(sweep.glob("*_*/config.yaml"))]
    write_archive(runs, tmp_path / "packed")
    again = report_on(tmp_path / "packed", str(tmp_path / "out"))
    tables = sorted(page.parent.rglob("*.csv"))
    assert len(tables) == 6
    for table in tables:
        other = again.parent / table.relative_to(page.parent)
        assert other.read_text() == table.read_text()


def test_the_page_says_what_is_missing_and_what_is_wrong(page):
    text = page.read_text(encoding="utf-8")
    assert "Missing in S-Turn: raw." in text
    assert "No runs in H-Shaped Pathways and Three-Way Junction." in text
    assert "damaged/config.yaml" in text
    assert "<h1>9 stacks in Straight Road and S-Turn</h1>" in text
    assert "34 runs, 34 of them finished, of 9 stacks" in text


@pytest.mark.parametrize("plans", [{}, {"S-Turn": [Picture("ego", "1 collision", "data:,")]}])
def test_the_page_names_agents_without_drives(plans):
    text = render_page(Report((), (), ()), Drives(plans, {}, ["a has no drives"]))
    assert text.count("a has no drives") == 1
    assert text.count('id="drives"') == text.count('href="#drives"') == 1
    assert ("The scene from above" in text) == bool(plans)


def test_a_figure_saved_again_is_the_same_byte_for_byte(tmp_path):
    config = config_of()
    run = write_run(tmp_path / "run", config, rows_of(config, letters(3)))
    conditions = [Condition("greedy", "normal", 12.0)]
    series = {"ego+obj": [read_run(run)], "ego+obj+seg2": []}
    grid = grid_of("straight_road", series, conditions, Bootstrap(50))

    def saved(name):
        figure = draw_bars([grid])
        save(figure, tmp_path / name)
        return svg(figure), *((tmp_path / f"{name}.{k}").read_bytes() for k in ("png", "pdf"))

    assert saved("first") == saved("second")


def test_the_page_asks_for_nothing(page):
    text = page.read_text(encoding="utf-8")
    assert set(re.findall(r'(?:src|srcset|href)="(data:[a-z+/0-9]+|#|[^"]*)', text)) == {
        "data:image/svg+xml",
        "#",
    }
    assert "url(" not in text
    assert "@import" not in text


PROBE = """<!DOCTYPE html><html><body><script>
const found = {};
async function look(width) {
  const frame = document.createElement('iframe');
  frame.style.cssText = `width: ${width}px; height: 900px; border: 0`;
  document.body.append(frame);
  frame.srcdoc = PAGE;
  await new Promise(done => { frame.onload = done; });
  const inside = frame.contentDocument, root = inside.documentElement;
  const images = [...inside.images];
  await Promise.all(images.map(image => image.decode()));
  const boxes = images.map(image => image.getBoundingClientRect());
  found[width] = {
    overflow: root.scrollWidth - root.clientWidth,
    images: images.length,
    broken: images.filter(image => !image.naturalWidth).length,
    in_a_row: boxes.filter(box => box.top === boxes[0].top).length,
    narrowest: Math.min(...boxes.map(box => box.width)),
    anchors: [...inside.querySelectorAll('nav a')].every(
      a => inside.getElementById(a.getAttribute('href').slice(1))),
    fetched: frame.contentWindow.performance.getEntriesByType('resource')
      .filter(entry => !entry.name.startsWith('data:')).length,
  };
}
look(1400).then(() => look(400)).then(() => { document.title = JSON.stringify(found); });
</script></body></html>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed to open the page in")
def test_a_browser_shows_the_page_on_wide_and_narrow_screens(page, tmp_path):
    text = page.read_text(encoding="utf-8")
    probe = tmp_path / "probe.html"
    quoted = json.dumps(text).replace("</", r"<\/")
    probe.write_text(PROBE.replace("PAGE", quoted), encoding="utf-8")
    arguments = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000"]
    arguments += [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1500,1000"]
    shown = subprocess.run(
        [CHROMIUM, *arguments, "--dump-dom", probe.as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    ).stdout  # fmt: skip
    titles = re.findall(r"<title>(\{.*?\})</title>", shown)
    assert titles, shown[:500]
    found = json.loads(titles[0].replace("&amp;", "&"))
    for width in ("1400", "400"):
        seen = found[width]
        assert (seen["overflow"], seen["broken"], seen["fetched"]) == (0, 0, 0)
        assert seen["images"] == 8  # four figures of two scenes
        assert seen["anchors"]
    assert found["1400"]["in_a_row"] == 2
    assert found["400"]["in_a_row"] == 1
    assert found["400"]["narrowest"] > 300
