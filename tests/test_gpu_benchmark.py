"""The benchmark of a GPU runs to its end on a CPU, and says so where there is no GPU."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "benchmarks" / "gpu.py"


def run(*arguments):
    environment = os.environ | {
        "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": "",
    }  # fmt: skip
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment)


def test_without_a_gpu_it_says_so_in_one_line():
    result = run()
    assert result.returncode == 2
    assert result.stderr.strip().splitlines() == [
        "no CUDA device here; --device cpu --quick tries the script"
    ]


def test_the_quick_version_measures_every_part(tmp_path):
    result = run(
        "--device", "cpu", "--quick", "--recorded", "--rounds", 1, "--output", tmp_path
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "report.md").read_text() == result.stdout.removesuffix("\n")
    report = json.loads((tmp_path / "report.json").read_text())
    # two encoders, two precisions, graph and eager, and TorchRL's own
    assert len(report["update"]["rows"]) == 9
    assert report["transforms"]["rows"][0]["compiled, ms"] > 0
    for part in ("streets", "training"):
        assert "no simulator was run" in report[part]["notes"][0]
        assert report[part]["rows"][0]["frames/s"] > 0
    (row,) = report["training"]["rows"]
    # 2,000,000 frames at the rate of the second half
    assert abs(row["min for 2,000,000"] * 60 * row["frames"] / row["s"] - 2_000_000) < 1
