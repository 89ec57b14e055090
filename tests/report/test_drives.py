"""Plans and films of what evaluations left beside their tables."""

import numpy as np
import pytest
import yaml

pytest.importorskip("scipy", reason="reports are an extra")
pytest.importorskip("shapely", reason="plans are of scenes")

from flowrep.config import CONF_DIR
from flowrep.report.page import DRIVES, drives_of, tracks_of
from flowrep.report.storage import read_run, read_runs
from tests.report.folders import config_of, rows_of, write_run


def write_drives(folder, **changes):
    """Three episodes of 2, 3 and 1 positions: the last is the first by its seed."""
    saved = {
        "positions": np.arange(12, dtype=np.float32).reshape(6, 2),
        "starts": np.array([0, 2, 5, 6]),
        "evaluation": np.array(["final"] * 3),
        "policy": np.array(["greedy"] * 3),
        "speed": np.array(["normal"] * 3),
        "fps": np.full(3, 12.0),
        "frames": np.full(3, 1000),
        "episode_seed": np.array([101, 102, 100]),
        "outcome": np.array(["success", "collision", "out_of_bounds"]),
    }
    np.savez(folder / DRIVES, **saved | changes)


def run_in(folder, seed=0, **changes):
    config = config_of(seed=seed) | changes
    return write_run(folder, config, rows_of(config, "sco"))


def test_tracks_are_those_of_the_first_episodes(tmp_path):
    write_drives(run_in(tmp_path / "run"))
    first, second = tracks_of(read_run(tmp_path / "run"), 2)
    assert (first.outcome, second.outcome) == ("out_of_bounds", "success")
    np.testing.assert_array_equal(first.points_m, [[10, 11]])
    np.testing.assert_array_equal(second.points_m, [[0, 1], [2, 3]])


@pytest.mark.parametrize(
    "changes",
    [
        {"evaluation": np.array(["training"] * 3)},
        {"policy": np.array(["sampled"] * 3)},
        {"speed": np.array(["low"] * 3)},
        {"fps": np.full(3, 6.0)},
        {"frames": np.full(3, 500)},
    ],
    ids=str,
)
def test_only_greedy_drives_of_the_finished_agent_as_it_was_trained_are_drawn(tmp_path, changes):
    write_drives(run_in(tmp_path / "run"), **changes)
    assert tracks_of(read_run(tmp_path / "run"), 2) == []


@pytest.mark.parametrize("content", [None, b"", b"PK\x03\x04 damaged"])
def test_a_run_without_drives_or_films_is_a_line(tmp_path, content):
    run_in(tmp_path / "run")
    if content is not None:
        (tmp_path / "run" / DRIVES).write_bytes(content)
    drives = drives_of([read_run(tmp_path / "run")], trajectories=2, videos=1)
    assert (drives.plans, drives.films) == ({}, {})
    assert ["plan" in line for line in drives.warnings] == [True, False]


def test_a_plan_and_films_of_one_agent_of_each_stack(tmp_path):
    scene = yaml.safe_load((CONF_DIR / "scene" / "straight_road.yaml").read_text())
    for seed in (1, 0):
        folder = run_in(tmp_path / f"run{seed}", scene=scene, seed=seed)
        write_drives(folder)
        (folder / "videos").mkdir()
        for name in ("a", "b"):
            (folder / "videos" / f"{name}.mp4").write_bytes(b"film")
    runs, _ = read_runs([tmp_path])
    drives = drives_of(runs, trajectories=3, videos=1)
    ((place, (plan,)),) = drives.plans.items()
    assert (place, plan.title) == ("Straight Road", "ego+obj, seed 0 (run0)")
    assert plan.caption == "3 drives: 1 out of bounds, 1 success, 1 collision"
    assert plan.data.startswith("data:image/png;base64,")
    ((episode, (film,)),) = drives.films.items()
    assert (episode, film.data) == ("Straight Road, A", "data:video/mp4;base64,ZmlsbQ==")
    assert drives.warnings == []
