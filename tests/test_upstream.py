"""docs/upstream.md: each bug is there as described, in the versions installed."""

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[1] / "docs" / "upstream.md").read_text("utf-8")
BUGS = dict(re.findall(r"^## (.*?)$.*?```python\n(.*?)```", PAGE, re.DOTALL | re.MULTILINE))


@pytest.mark.parametrize("title", BUGS)
def test_the_bug_is_still_there(title):
    pytest.importorskip("gymnasium")
    exec(compile(BUGS[title], title, "exec"), {"__name__": "bug"})
