"""What a release is made of agrees: versions, what is installed how, the Dockerfile."""

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


def test_pip_install_lines_name_extras_that_exist_and_read_alike():
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    section = project.split("[project.optional-dependencies]")[1].split("\n[")[0]
    extras = set(re.findall(r"^(\w+) = ", section, re.MULTILINE))
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/*")]
    code = [*ROOT.glob("tests/**/*.py"), *ROOT.glob("flowrep/**/*.py")]
    for path in (path for path in (*pages, *code) if path.suffix in (".md", ".py", ".ipynb")):
        text = path.read_text("utf-8")
        for quoted in re.findall(r"pip install '(?:\.|flowrep-rl)\[([\w,{}]+)\]'", text):
            assert set(quoted.split(",")) <= extras | {"{extra}"}, path
        # `flowrep` is another project's distribution
        assert not re.search(r"pip install ['\"]?flowrep(?!-rl)", text), path
        # a clone is what there is: pages and examples install `.`, with quotes for every shell
        if path in pages:
            assert not re.search(r"pip install (\.\[|\"|-e|'?flowrep)", text), path
