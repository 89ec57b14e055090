"""docs/upstream.md: each bug is there as described, in the versions installed."""

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[1] / "docs" / "upstream.md").read_text("utf-8")
BUGS = dict(re.findall(r"^## (.*?)$.*?```python\n(.*?)```", PAGE, re.DOTALL | re.MULTILINE))


def test_each_bug_has_a_reproduction():
    *titles, known = re.findall(r"^## (.*)$", PAGE, re.MULTILINE)
    assert known == "Known upstream"  # reported there: links, no code
    assert titles
    assert list(BUGS) == titles


@pytest.mark.parametrize("title", BUGS)
def test_the_bug_is_still_there(title):
    assert "assert " in BUGS[title]  # what is run below can fail
    exec(compile(BUGS[title], title, "exec"), {"__name__": "bug"})
