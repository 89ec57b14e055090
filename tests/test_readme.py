"""The README's Python runs as it stands."""

import re
from itertools import chain
from pathlib import Path

import pytest

from tests.transforms.fake_env import FakeSensorEnv

README = Path(__file__).parents[1] / "README.md"


def test_the_readmes_python_runs_with_the_readers_own_env():
    (block,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    namespace = {"my_env": FakeSensorEnv((2,))}
    exec(block.replace(" 42.0]", " 3.0]"), namespace)  # the env's maps are 7 x 5
    assert namespace["rollout"]["obj"].shape[-3] == 2
    assert set(namespace["rollout"].keys()) >= {"ego", "obj"}


def test_every_picture_of_the_readme_is_there_and_small():
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README.read_text(encoding="utf-8"))
    assert pictures
    for picture in pictures:
        assert (README.parent / picture).stat().st_size < 600_000, picture


OUTSIDE = ("*.md", "paper/*.md", "outputs/**/README.md", "flowrep/pretrained/*.md")


@pytest.mark.parametrize("pattern", OUTSIDE)
def test_links_of_pages_outside_of_docs_lead_somewhere(pattern):
    for page in README.parent.glob(pattern):
        links = re.findall(r"\]\(([^)#\s]+)(?:#[\w-]+)?\)", page.read_text(encoding="utf-8"))
        assert [x for x in links if "://" not in x and not (page.parent / x).exists()] == [], page


def test_the_readmes_agents_are_those_of_the_results_and_of_the_trained_agents_card():
    rows = README.read_text(encoding="utf-8").split("| pedestrians |")[1].splitlines()[2:5]
    taught, demo = zip(*(line.split("|")[2:4] for line in rows))
    results = (README.parent / "paper" / "results.md").read_text(encoding="utf-8")
    (row,) = re.findall(r"^\|recipe 3.*\|SR\|`\[ego,obj\]`\|.*", results, re.MULTILINE)
    assert [cell.strip() for cell in taught] == row.split("|")[5:8]
    card = (README.parent / "flowrep" / "pretrained" / "README.md").read_text(encoding="utf-8")
    row, *_ = re.findall(r"^\| Straight Road \|.*", card, re.MULTILINE)
    assert [cell.split()[0] for cell in demo] == [f"{float(c):.0f}" for c in row.split("|")[2:5]]


def test_every_page_and_make_install_the_same_torch():
    pages = (README, README.parent / "docs" / "getting_started.md", README.parent / "Makefile")
    asked = [re.findall(r"torch==[\d.]+", page.read_text(encoding="utf-8")) for page in pages]
    assert all(asked)
    assert len(set(chain(*asked))) == 1
