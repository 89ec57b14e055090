"""Agents drive their evaluated episodes again: the same ones, to the same end."""

import base64
import csv

import imageio.v3 as imageio
import pytest

pytest.importorskip("scipy", reason="reports are an extra")
pytest.importorskip("pybullet", reason="agents drive in the simulated street")

from flowrep.evaluate import evaluate
from flowrep.report.replay import drive_again
from flowrep.report.runs import read_runs
from tests.test_evaluate import asked, trained

pytestmark = pytest.mark.slow

DRIVEN = {"device": "cpu", "trust": None}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = trained(tmp_path_factory.mktemp("runs") / "run", "representations=[obj,seg2]")
    evaluate(asked(folder), [folder])
    return folder


def test_an_agent_drives_its_episodes_as_its_table_says(run):
    runs, _ = read_runs([run.path])
    drives = drive_again(runs, trajectories=2, videos=1, **DRIVEN)
    assert drives.complaints == []
    ((scene, (plan,)),) = drives.plans.items()
    assert (scene, plan.title) == ("Straight Road", "obj+seg2, seed 0 (run)")
    assert plan.told.startswith("of 2, ")
    assert plan.picture.startswith("data:image/png;base64,")
    with run.evaluation_path.open(newline="") as file:
        first = next(csv.DictReader(file))
    (film,) = drives.films
    assert film.title == f"Straight Road, episode {first['episode_seed']}"
    data = base64.b64decode(film.parts[0].film.removeprefix("data:video/mp4;base64,"))
    frames = imageio.imread(data, extension=".mp4", plugin="FFMPEG")
    assert len(frames) == int(first["length"]) + 1
    assert film.parts[0].told.endswith(f" after {int(first['length']) / 12:.1f} s")


def test_an_agent_that_drives_otherwise_than_its_table_says_is_named(run):
    table = run.evaluation_path.read_text()
    try:
        run.evaluation_path.write_text(
            table.replace("collision,", "timeout,").replace("out_of_bounds,", "timeout,")
        )
        runs, _ = read_runs([run.path])
        (complaint,) = drive_again(runs, trajectories=2, videos=0, **DRIVEN).complaints
        assert "drives 2 of 2 episodes otherwise here" in complaint
    finally:
        run.evaluation_path.write_text(table)


def test_a_run_without_its_checkpoint_is_a_line(run):
    checkpoint = run.checkpoint_path.rename(run.path / "aside")
    try:
        runs, _ = read_runs([run.path])
        drives = drive_again(runs, trajectories=1, videos=1, **DRIVEN)
    finally:
        checkpoint.rename(run.checkpoint_path)
    assert (drives.plans, drives.films) == ({}, [])
    assert "checkpoint" in drives.complaints[0]
