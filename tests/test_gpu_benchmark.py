"""The benchmark of a GPU runs to its end on a CPU, and says so where there is no GPU."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]


def run(*arguments):
    environment = os.environ | {
        "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": "",
    }  # fmt: skip
    command = [sys.executable, str(ROOT / "benchmarks" / "gpu.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment)


def test_without_a_gpu_it_says_so_in_one_line():
    result = run()
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1


def test_the_quick_version_measures_every_part(tmp_path):
    result = run("--device", "cpu", "--quick", "--rounds", 1, "--output", tmp_path)
    assert result.returncode == 0, result.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    # two encoders, two precisions, graph and eager, and TorchRL's own
    assert len(report["update"]["rows"]) == 9
    assert report["transforms"]["rows"][0]["compiled, ms"] > 0
    assert [row["frames/s"] > 0 for row in report["envs"]["rows"]] == [True, True]
    assert report["training"]["rows"][0]["frames/s"] > 0
