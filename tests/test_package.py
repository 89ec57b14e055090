"""The sdist and the wheel: built, checked, installed where nothing else of flowrep is."""

import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("build", reason="pip install '.[dev]'")
pytest.importorskip("twine", reason="pip install '.[dev]'")

import flowrep
from tests.running import ROOT, run_python

VERSION = flowrep.__version__

pytestmark = pytest.mark.slow


def python(*arguments, executable=sys.executable, **options):
    line = [str(each) for each in (executable, *arguments)]
    result = subprocess.run(line, capture_output=True, text=True, **options)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The sdist and the wheel that is built from it."""
    pytest.importorskip("hatchling", reason="pip install '.[dev]'")
    folder = tmp_path_factory.mktemp("dist")
    python("-m", "build", "--no-isolation", "--outdir", folder, ROOT)
    return (
        folder / f"flowrep_rl-{VERSION}.tar.gz",
        folder / f"flowrep_rl-{VERSION}-py3-none-any.whl",
    )


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """A fresh environment with the wheel, and with what the tests' own has beside flowrep."""
    folder = tmp_path_factory.mktemp("fresh") / "venv"
    venv.create(folder, with_pip=False)
    (packages,) = folder.glob("lib/python*/site-packages")
    outside = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "beside.pth").write_text("\n".join(outside))
    pip = ["-m", "pip", "--python", folder, "install", "--no-deps", "--no-index", "--quiet"]
    python(*pip, "--disable-pip-version-check", built[1])
    return folder / "bin"


def test_an_index_would_take_both(built):
    assert "PASSED" in python("-m", "twine", "check", "--strict", *built)


def test_the_wheel_has_the_configs_and_nothing_beside_the_package(built):
    with zipfile.ZipFile(built[1]) as wheel:
        names = set(wheel.namelist())
    configs = {f"flowrep/{path.relative_to(ROOT)}" for path in ROOT.glob("conf/**/*.*ml")}
    assert configs | {"flowrep/py.typed"} <= names
    assert {name.split("/")[0] for name in names} == {"flowrep", f"flowrep_rl-{VERSION}.dist-info"}
    assert not [name for name in names if name.endswith((".pyc", ".png"))]


def test_the_sdist_has_what_a_clone_has(built):
    with tarfile.open(built[0]) as sdist:
        names = {name.split("/", 1)[1] for name in sdist.getnames() if "/" in name}
    assert {"conf/train.yaml", "tests/test_package.py", "docs/index.md", "Makefile"} <= names
    assert {"mkdocs.yml", "CITATION.cff", "LICENSE", "Dockerfile", "examples/tensors.py"} <= names


def test_the_installed_wheel_has_its_commands_and_configs(installed, tmp_path):
    where = {"cwd": tmp_path, "env": {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}}
    code = (
        "import flowrep, flowrep.geometry; from flowrep.config import CONF_DIR;"
        "print(flowrep.__version__, flowrep.__file__, (CONF_DIR / 'train.yaml').is_file())"
    )
    said = python("-c", code, executable=installed / "python", **where)
    version, place, has_configs = said.split()
    assert (version, has_configs) == (VERSION, "True")
    assert Path(place).is_relative_to(installed.parent)
    line = "scene=s_turn", "--cfg", "job"
    assert "name: s_turn" in python(*line, executable=installed / "flowrep-train", **where)


def test_importing_notices_the_other_distribution_of_that_name(tmp_path):
    other = tmp_path / "flowrep-0.6.7.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: flowrep\nVersion: 0.6.7\n")
    for path, said in ((f"{ROOT}", ""), (f"{ROOT}:{tmp_path}", "pip uninstall")):
        result = run_python("-c", "import flowrep", env=os.environ | {"PYTHONPATH": path})
        assert result.returncode == 0
        assert said in result.stderr
        assert ("0.6.7" in result.stderr) is bool(said)
