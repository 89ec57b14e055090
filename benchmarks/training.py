"""Frames per second of a short training and the share of its time outside gradient updates.

    python benchmarks/training.py [--frames 12_000] [--rounds 2] [--base FOLDER] [overrides ...]

Each variant runs `python -m flowrep.train preset=laptop <overrides>` without evaluations, in turn:
with all threads, with one, and with all of them beside a busy loop (`--alone`: the first only).
With `--base`, the same variants of another checkout of flowrep run as well. Rates are of the second
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


def train(*overrides: str, root: Path = HERE, **environment: str) -> dict[str, float]:
    """Returns the means of metrics.csv's columns over the second half of a training."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "flowrep.train", *WITHOUT_EVALUATIONS, *overrides]
        subprocess.run(
            [*command, f"hydra.run.dir={folder}/run"],
            env=os.environ | {"PYTHONPATH": str(root)} | environment,
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
    parser.add_argument("--alone", action="store_true", help="with all threads and no busy loop")
    parser.add_argument("overrides", nargs="*", default=["preset=laptop"])
    args = parser.parse_args()
    roots = {"": HERE} | ({"base, ": args.base.resolve()} if args.base else {})
    overrides = [*args.overrides, f"total_frames={args.frames}"]
    measured: dict[str, list[dict[str, float]]] = {}
    for _, (name, root) in product(range(args.rounds), roots.items()):
        measured.setdefault(f"{name}all threads", []).append(train(*overrides, root=root))
        if args.alone:
            continue
        one = train(*overrides, root=root, OMP_NUM_THREADS="1")
        measured.setdefault(f"{name}one thread", []).append(one)
        busy = subprocess.Popen([sys.executable, "-c", BUSY])
        try:
            beside = train(*overrides, root=root)
        finally:
            busy.kill()
            busy.wait()
        measured.setdefault(f"{name}all threads, beside a busy loop", []).append(beside)
    print(f"{' '.join(overrides)}, {os.cpu_count()} cores, medians of {args.rounds}")
    print(f"| training | frames/s | min for {PAPER_FRAMES:,} | of all threads | outside updates |")
    print("| --- | --- | --- | --- | --- |")
    rates = {n: statistics.median(r["frames_per_second"] for r in f) for n, f in measured.items()}
    for name, runs in measured.items():
        outside = statistics.median(run["share_outside_updates"] for run in runs)
        rate, share = rates[name], rates[name] / rates["all threads"]
        minutes = PAPER_FRAMES / rate / 60
        print(f"| {name} | {rate:.0f} | {minutes:.0f} | {share:.0%} | {outside:.0%} |")


if __name__ == "__main__":
    main()
