"""docs/metrics.md: what a smoke run of each algorithm logs is explained there, and nothing else."""

import csv
import re
from pathlib import Path

import pytest

pytest.importorskip("pybullet", reason="training drives the simulated street")

from flowrep.config import group_choices
from flowrep.experiment.run import RunFolder
from flowrep.experiment.runner import Runner
from flowrep.progress import StopRequest
from tests.config.composing import composed

pytestmark = pytest.mark.slow

GLOSSARY = Path(__file__).parents[2] / "docs" / "metrics.md"


def explained() -> dict[str, set[str]]:
    """The keys in the first columns of the page's tables, by section."""
    sections = re.split(r"^## ", GLOSSARY.read_text("utf-8"), flags=re.MULTILINE)[1:]
    keys = {}
    for section in sections:
        firsts = re.findall(r"^\| (`.*?) \|", section, flags=re.MULTILINE)
        keys[section.splitlines()[0]] = {
            k for first in firsts for k in re.findall(r"`(\w+)`", first)
        }
    return keys


def test_every_algorithm_has_its_section():
    sections = [title for title in explained() if title.startswith("algorithm=")]
    assert sorted(sections) == [f"algorithm={name}" for name in group_choices("algorithm")]


@pytest.mark.parametrize("algorithm", group_choices("algorithm"))
def test_a_smoke_run_logs_what_is_explained(tmp_path, algorithm):
    config = composed("debug=smoke", f"algorithm={algorithm}", "device=cpu")
    training = Runner(config, RunFolder(tmp_path))
    training.train(StopRequest())
    training.close()
    with training.folder.metrics_path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    sections = explained()
    assert set(rows[0]) == sections["Every run"] | sections[f"algorithm={algorithm}"]
    assert all(value != "nan" for value in rows[-1].values())
    assert training.agent.updates > 20
