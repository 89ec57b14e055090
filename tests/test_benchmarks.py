"""The benchmarks measure what they say, and run to their end."""

import pytest

from tests.running import ROOT, run_here


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "rows"),
    [
        # a view, a frame, and each number of workers
        ("frames.py --scenes straight_road --sizes 40 --num-envs 2 --views 2 --steps 1 --rounds 1 "
         "--workers 0 1", 4),
        # two encoders in one precision or two, plain PyTorch, TorchRL's own
        ("update.py --sizes tiny --rounds 1 --threads 1", 4),
    ],
)  # fmt: skip
def test_a_benchmark_prints_its_tables(monkeypatch, capsys, arguments, rows):
    assert run_here(monkeypatch, ["python", *f"{ROOT}/benchmarks/{arguments}".split()]) == 0
    tables = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    heads = sum(set(line) <= set("| -") for line in tables)
    assert len(tables) - 2 * heads >= rows
