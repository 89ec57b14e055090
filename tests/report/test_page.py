"""A whole report: the command, its page in a browser, and the drives and films that it shows."""

import os
import re
import shlex
import sys
from itertools import product

import numpy as np
import pytest
import yaml

pytest.importorskip("scipy", reason="reports are an extra")
pytest.importorskip("jinja2", reason="reports are an extra")

from flowrep.config import CONF_DIR
from flowrep.config.cli import value_of
from flowrep.experiment.run import DRIVES
from flowrep.report.__main__ import ReportConfig, main, report
from flowrep.report.figures import draw_bars, encoded
from flowrep.report.page import plans_and_films_of, tracks_of
from flowrep.report.runs import Condition, grid_of, read_run, read_runs
from tests.report.folders import config_of, letters, rows_of, run_in, write_run


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
    numbers = {"trajectories": 1, "videos": 1}
    return report(ReportConfig(run=[str(sweep)], output=None, policy="greedy", **numbers))


@pytest.mark.slow
def test_each_experiment_has_its_figure_and_tables_in_every_form(page):
    files = (path for path in page.parent.rglob("*") if path.is_file())
    found = {path.relative_to(page.parent).as_posix() for path in files}
    names = ("flow_composition", "complementary", "frame_rate", "learning_curves")
    drawn = {f"{name}/{name}.{kind}" for name in names for kind in ("png", "pdf")}
    tables = {f"{name}/{name}_success" for name in names[:3]} | {"failure_causes/failure_causes"}
    tables |= {f"{name}/{name}_differences" for name in names[:2]}
    written = {f"{name}.{kind}" for name in tables for kind in ("tex", "csv")}
    assert found == drawn | written | {"index.html"}


@pytest.mark.slow
def test_the_page_holds_all_it_shows_and_says_what_is_missing_and_wrong(page):
    text = page.read_text(encoding="utf-8")
    assert '<td class="missing">missing</td>' in text
    assert "damaged/config.yaml" in text
    assert text.count(DRIVES) == 7  # a warning for one agent of each stack and scene
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
    monkeypatch.setattr(sys, "argv", ["flowrep-report", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr()
    assert ended.value.code == 2
    assert said.err.startswith("error: ")
    assert said.err.count("\n") == 1
    assert (f"{tmp_path}/run/config.yaml" in said.out) == damaged


def test_what_was_found_is_printed_and_where_it_was_written(tmp_path, monkeypatch, capsys):
    run = run_in(tmp_path, "run", "soccc")
    monkeypatch.setattr(sys, "argv", ["flowrep-report", str(run), f"output={tmp_path / 'out'}"])
    main()
    said = capsys.readouterr().out
    assert all(name in said for name in ("ego+obj", "Straight Road"))
    assert "0.333 [0.048–2.326]" in said  # 1 out of bounds to 3 collisions; Wilson's of 1 of 4
    assert str(tmp_path / "out" / "index.html") in said
    assert (tmp_path / "out" / "index.html").is_file()


# Drives and films.


def test_a_link_in_a_runs_folder_leads_a_report_nowhere(tmp_path, victim, monkeypatch):
    run, before = run_in(tmp_path, "run"), victim.read_text()
    (run / "report").mkdir()
    (run / "report" / "index.html").symlink_to(victim)
    monkeypatch.setattr("sys.argv", ["report", f"run={run}"])
    main()
    assert "<html" in (run / "report" / "index.html").read_text()
    section = run / "report" / "success"
    section.rename(tmp_path / "moved")
    section.symlink_to(victim.parent)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert (victim.read_text(), os.listdir(victim.parent)) == (before, ["victim"])


def write_drives(folder, **changes):
    """Three episodes of 2, 3 and 1 positions: the last is the first by its seed."""
    saved = {
        "positions": np.arange(12, dtype=np.float32).reshape(6, 2),
        "starts": np.array([0, 2, 5, 6]),
        "scene_id": np.array([""] * 3),  # as in the table
        "evaluation": np.array(["final"] * 3),
        "policy": np.array(["greedy"] * 3),
        "speed": np.array(["normal"] * 3),
        "fps": np.full(3, 12.0),
        "frames": np.full(3, 1000),
        "episode_seed": np.array([101, 102, 100]),
        "outcome": np.array(["success", "collision", "out_of_bounds"]),
    }
    np.savez(folder / DRIVES, **saved | changes)


def test_tracks_are_those_of_the_first_episodes(tmp_path):
    write_drives(run_in(tmp_path, "run", "sco"))
    first, second = tracks_of(read_run(tmp_path / "run"), 2)
    assert (first.outcome, second.outcome) == ("out_of_bounds", "success")
    np.testing.assert_array_equal(first.points_m, [[10, 11]])
    np.testing.assert_array_equal(second.points_m, [[0, 1], [2, 3]])


def test_only_greedy_drives_of_the_finished_agent_as_it_was_trained_are_drawn(tmp_path):
    run = run_in(tmp_path, "run", "sco")
    others = {"evaluation": "training", "policy": "sampled", "speed": "low", "fps": 6, "frames": 5}
    others["scene_id"] = "1a2b3c4d"  # it may be evaluated in another scene, too
    for key, value in others.items():
        write_drives(run, **{key: np.full(3, value)})
        assert tracks_of(read_run(run), 2) == [], key


@pytest.mark.parametrize("content", [None, b"", b"PK\x03\x04 damaged"])
def test_a_run_without_drives_or_films_is_a_line(tmp_path, content):
    run = run_in(tmp_path, "a run, mine", "sco")
    if content is not None:
        (run / DRIVES).write_bytes(content)
    drives = plans_and_films_of([read_run(run)], trajectories=2, videos=1)
    assert (drives.plans, drives.films) == ({}, {})
    assert ["plan" in line for line in drives.warnings] == [True, False]
    *_, where, what = shlex.split(drives.warnings[1])  # as a shell reads the remedy
    assert (value_of(where), what) == (str(run), "video=1")


def test_a_plan_and_films_of_one_agent_of_each_stack(tmp_path):
    scene = yaml.safe_load((CONF_DIR / "scene" / "straight_road.yaml").read_text())
    for seed in (1, 0):
        config = config_of(seed=seed) | {"scene": scene}
        folder = write_run(tmp_path / f"run{seed}", config, rows_of(config, "sco"))
        write_drives(folder)
        (folder / "videos").mkdir()
        for name in ("a", "b"):
            (folder / "videos" / f"{name}.mp4").write_bytes(b"film")
    runs, _ = read_runs([tmp_path])
    drives = plans_and_films_of(runs, trajectories=3, videos=1)
    ((place, (plan,)),) = drives.plans.items()
    assert (place, plan.title) == ("Straight Road", "ego+obj, seed 0 (run0)")
    assert plan.caption == "drives: 1 out of bounds, 1 success, 1 collision"
    assert plan.data.startswith("data:image/png;base64,")
    ((episode, (film,)),) = drives.films.items()
    assert (episode, film.data) == ("Straight Road, A", "data:video/mp4;base64,ZmlsbQ==")
    assert drives.warnings == []


def test_a_run_whose_scene_is_unknown_is_a_line_and_the_others_have_their_plan(tmp_path):
    scene = yaml.safe_load((CONF_DIR / "scene" / "straight_road.yaml").read_text())
    for stack, changes in (("raw", {}), ("ego", {"paths": "nowhere"})):
        config = config_of(stack=stack) | {"scene": scene | changes}
        write_drives(write_run(tmp_path / stack, config, rows_of(config, "sco")))
    runs, _ = read_runs([tmp_path])
    drives = plans_and_films_of(runs, trajectories=1, videos=0)
    assert [plan.title.split(",")[0] for plan in drives.plans["Straight Road"]] == ["raw"]
    (warning,) = drives.warnings
    assert str(tmp_path / "ego") in warning
    assert "paths" in warning


@pytest.mark.parametrize("linked", ["film", "folder"])
def test_a_film_that_lies_outside_of_the_run_is_not_embedded(tmp_path, linked):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "a.mp4").write_bytes(b"secret")
    run = run_in(tmp_path, "run", "sco")
    if linked == "folder":
        (run / "videos").symlink_to(tmp_path / "elsewhere")
    else:
        (run / "videos").mkdir()
        (run / "videos" / "a.mp4").symlink_to(tmp_path / "elsewhere" / "a.mp4")
    drives = plans_and_films_of([read_run(run)], trajectories=0, videos=1)
    assert drives.films == {}
    (warning,) = drives.warnings
    # the remedy is one that the command takes
    command, _, value = warning.rpartition(" ")[2].partition("=")
    assert (command, value) == ("video", "1")
