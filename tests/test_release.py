"""One version, wherever it is written."""

import re
from pathlib import Path

import yaml

import flowrep

ROOT = Path(__file__).parents[1]


def test_every_file_names_the_same_version():
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    (packaged,) = re.findall(r'^version = "(.+)"$', project, re.MULTILINE)
    newest = re.findall(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)[0]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))["version"]
    assert flowrep.__version__ == packaged == newest == cited
