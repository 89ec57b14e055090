"""The documentation: every transform has a page, what pages show runs, links lead somewhere."""

import re
from pathlib import Path

import pytest
import yaml

from flowrep import transforms
from flowrep.transforms.configs import CONFIGS
from tests.transforms.fake_env import FakeSensorEnv

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


def navigation(entries):
    """Yields the pages that a navigation names, however deep."""
    for entry in entries:
        if isinstance(entry, str):
            yield entry
        else:
            for value in entry.values():
                yield from navigation([value] if isinstance(value, str) else value)


def python_of(page):
    return "\n".join(re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL))


def test_every_transform_has_its_page():
    written = "\n".join(page.read_text("utf-8") for page in (DOCS / "transforms").glob("*.md"))
    documented = set(re.findall(r"^::: flowrep\.transforms\.(\w+)", written, re.MULTILINE))
    assert documented == {
        config._target_.rsplit(".", 1)[1] for config in (make() for make in CONFIGS.values())
    }
    assert documented <= set(transforms.__all__)


def test_the_navigation_names_every_page_once():
    site = yaml.safe_load((DOCS.parent / "mkdocs.yml").read_text("utf-8"))
    named = list(navigation(site["nav"]))
    assert sorted(named) == [str(page.relative_to(DOCS)) for page in PAGES]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_to_pages_and_pictures_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#\s]+)(?:#[\w-]+)?\)", page.read_text("utf-8"))
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert missing == []


def test_the_env_guide_runs_with_the_readers_own_env():
    namespace = {"my_env": FakeSensorEnv((2,))}
    exec(python_of(DOCS / "use_in_your_env.md"), namespace)
    assert namespace["rollout"]["obj"].shape[-3] == 2
    assert len(namespace["stack"]) > 1
    assert namespace["valid"].all()


def test_the_data_guide_runs_and_gives_what_it_says():
    namespace = {}
    exec(python_of(DOCS / "bring_your_own_data.md"), namespace)
    # TartanAir's NED: the camera's x is forward, so 2 m along x are 2 m along OpenCV's z.
    assert namespace["prev_from_curr"][:3, 3].tolist() == [0.0, 0.0, 2.0]
