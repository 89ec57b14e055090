"""The notebook's cells run from the first to the last, and print what its text says."""

import json
from pathlib import Path

NOTEBOOK = Path(__file__).parents[2] / "examples" / "raw_ego_obj.ipynb"


def test_the_notebook_says_that_raw_is_ego_plus_obj(capsys):
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    # readers see its pictures without running it
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    scope = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), scope)
    printed = capsys.readouterr().out
    lines = dict(line.split(":", 1) for line in printed.splitlines())
    px = {name: float(value.removesuffix("px")) for name, value in lines.items() if "px" in value}
    assert px["largest |raw - ego - obj|"] < 1e-5
    assert px["largest |obj| off people"] == 0
    assert px["median  |obj| on people"] > 0.1
    assert px["ego flow of a camera that stands still"] == 0
    assert lines["obj is then raw"].strip() == "True"
