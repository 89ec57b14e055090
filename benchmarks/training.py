"""Frames per second of a short training and the share of its time outside gradient updates.

    python benchmarks/training.py [--frames 12_000] [--rounds 2] [--base FOLDER] [overrides ...]

The variants of `python -m flowrep.train <overrides>` run in turn, without evaluations: updates on
one thread and on a thread per core, each alone and beside a busy loop (`--alone`: only the first
variant). With `--base`, those of another checkout of flowrep run as well. Rates are of the second
half of a run; the minutes are those of the paper's 2,000,000 frames at that rate.
"""

import argparse
import csv
import os
import statistics
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path

HERE = Path(__file__).parents[1]
WITHOUT_EVALUATIONS = [
    "evaluation.every_frames=0", "evaluation.final_episodes=1", "evaluation.speeds=[normal]",
    "evaluation.baselines=[]", "evaluation.video=false",
]  # fmt: skip
BUSY = "while True: pass"
PAPER_FRAMES = 2_000_000  # Table II


def variants(cores: int, *, alone: bool = False) -> list[tuple[str, str, bool]]:
    """Returns name, override and whether a busy loop runs beside, for each variant."""
    threads = {"one thread": "threads=1", f"{cores} threads": f"threads={cores}"}
    each = [(name, override, False) for name, override in threads.items()]
    busy = [(f"{name}, beside a busy loop", override, True) for name, override, _ in each]
    return each[:1] if alone else each + busy


def train(*overrides: str, root: Path = HERE) -> dict[str, float]:
    """Returns the means of metrics.csv's columns over the second half of a training."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "flowrep.train", *WITHOUT_EVALUATIONS, *overrides]
        subprocess.run(
            [*command, f"hydra.run.dir={folder}/run"],
            env=os.environ | {"PYTHONPATH": str(root)},
            cwd=folder,
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        with open(f"{folder}/run/metrics.csv", newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    rows = rows[len(rows) // 2 :]
    names = ("frames_per_second", "share_outside_updates")
    return {name: statistics.fmean(float(row[name]) for row in rows) for name in names}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=12_000)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--base", type=Path, help="another checkout, to compare with")
    parser.add_argument("--alone", action="store_true", help="one thread and no busy loop")
    parser.add_argument("overrides", nargs="*", default=["preset=laptop"])
    args = parser.parse_args()
    roots = {"": HERE} | ({"base, ": args.base.resolve()} if args.base else {})
    overrides = [*args.overrides, f"total_frames={args.frames}"]
    cores = os.cpu_count() or 1
    measured: dict[str, list[dict[str, float]]] = {}
    for _, (base, root), (name, threads, is_busy) in product(
        range(args.rounds), roots.items(), variants(cores, alone=args.alone)
    ):
        busy = subprocess.Popen([sys.executable, "-c", BUSY]) if is_busy else None
        try:
            measured.setdefault(base + name, []).append(train(*overrides, threads, root=root))
        finally:
            if busy is not None:
                busy.kill()
                busy.wait()
    print(f"{' '.join(overrides)}, {cores} cores, medians of {args.rounds}")
    print(f"| training | frames/s | min for {PAPER_FRAMES:,} | of one thread | outside updates |")
    print("| --- | --- | --- | --- | --- |")
    rates = {n: statistics.median(r["frames_per_second"] for r in f) for n, f in measured.items()}
    for name, runs in measured.items():
        outside = statistics.median(run["share_outside_updates"] for run in runs)
        rate, share = rates[name], rates[name] / rates["one thread"]
        minutes = PAPER_FRAMES / rate / 60
        print(f"| {name} | {rate:.0f} | {minutes:.0f} | {share:.0%} | {outside:.0%} |")


if __name__ == "__main__":
    main()
