"""The notebook runs from its first cell to its last, and shows what its text says."""

from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="pip install '.[dev]'")
nbclient = pytest.importorskip("nbclient", reason="pip install '.[dev]'")
pytest.importorskip("ipykernel", reason="pip install '.[dev]'")
pytest.importorskip("pybullet", reason="the notebook's street is simulated in PyBullet")

NOTEBOOK = Path(__file__).parents[2] / "examples" / "raw_ego_obj.ipynb"


def outputs_of(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def pictures(notebook):
    return sum("image/png" in output.get("data", {}) for output in outputs_of(notebook))


@pytest.mark.slow
def test_the_notebook_says_that_raw_is_ego_plus_obj():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert pictures(notebook) == 2  # readers see its outputs without running it
    resources = {"metadata": {"path": str(NOTEBOOK.parents[1])}}
    nbclient.NotebookClient(notebook, timeout=200, resources=resources).execute()
    assert pictures(notebook) == 2
    printed = "".join(output.get("text", "") for output in outputs_of(notebook))
    lines = dict(line.split(":", 1) for line in printed.splitlines())
    px = {name: float(value.removesuffix("px")) for name, value in lines.items() if "px" in value}
    assert px["largest |raw - ego - obj|"] < 1e-5
    assert px["largest |obj| off people"] == 0
    assert px["median  |obj| on people"] > 0.1
    assert px["ego flow of a camera that stands still"] == 0
    assert lines["obj is then raw"].strip() == "True"
