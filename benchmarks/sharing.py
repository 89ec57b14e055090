"""Frames a second of laptop trainings on a machine that does other work as well.

    python benchmarks/sharing.py [--seconds 40] [--preset laptop]

Trainings run as on the command line, in processes of their own. Each arrangement is measured for
some seconds from the moment when all of its trainings take updates; evaluations are switched off.
Run it on an otherwise idle machine.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

WARM_FRAMES = 3_000
POLL_S = 0.05
ONE_THREAD = {"OMP_NUM_THREADS": "1"}
BUSY = [sys.executable, "-c", "while True: pass"]


class Running:
    """A program that is ended with its context."""

    def __init__(self, command: Sequence[str], variables: dict[str, str]) -> None:
        self.command, self.variables = command, variables

    def __enter__(self) -> subprocess.Popen[bytes]:
        """Starts it."""
        self.process = subprocess.Popen(
            self.command,
            env=os.environ | self.variables,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        return self.process

    def __exit__(self, *_: object) -> None:
        """Kills it."""
        self.process.kill()
        self.process.wait()


def training(folder: Path, seed: int, preset: str, options: Sequence[str]) -> list[str]:
    return [
        sys.executable, "-m", "flowrep.train", f"preset={preset}", f"seed={seed}",
        f"hydra.run.dir={folder}", "evaluation.every_frames=0", "log_every_frames=64", *options,
    ]  # fmt: skip


def frames(folder: Path) -> int:
    """Returns the frames in the last whole row of metrics.csv, 0 without one."""
    try:
        rows = (folder / "metrics.csv").read_text().rpartition("\n")[0].splitlines()[1:]
    except FileNotFoundError:
        return 0
    return int(rows[-1].partition(",")[0]) if rows else 0


def rate(folders: Sequence[Path], processes: Sequence[subprocess.Popen[bytes]], s: float) -> float:
    """Returns the frames a second of all runs together, over `s` seconds."""
    while min(map(frames, folders)) < WARM_FRAMES:
        if any(process.poll() is not None for process in processes):
            raise SystemExit("a training ended early; run its command to see why")
        time.sleep(POLL_S)
    start, before = time.monotonic(), sum(map(frames, folders))
    time.sleep(s)
    after, end = sum(map(frames, folders)), time.monotonic()
    return (after - before) / (end - start)


def measure(
    runs: int,
    variables: dict[str, str],
    options: Sequence[str],
    busy: int,
    args: argparse.Namespace,
) -> float:
    """Returns the frames a second of `runs` trainings beside `busy` endless loops."""
    with tempfile.TemporaryDirectory() as root, ExitStack() as stack:
        for _ in range(busy):
            stack.enter_context(Running(BUSY, {}))
        folders = [Path(root, str(seed)) for seed in range(runs)]
        processes = [
            stack.enter_context(Running(training(f, seed, args.preset, options), variables))
            for seed, f in enumerate(folders)
        ]
        return rate(folders, processes, args.seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=40)
    parser.add_argument("--preset", default="laptop")
    args = parser.parse_args()
    single = (ONE_THREAD, ["num_workers=0"])
    arrangements = {
        "one training": (1, {}, [], 0),
        "one training, one thread, no workers": (1, *single, 0),
        "one training beside a busy loop": (1, {}, [], 1),
        "two trainings": (2, {}, [], 0),
        "two trainings, one thread each, no workers": (2, *single, 0),
        "two trainings beside a busy loop": (2, {}, [], 1),
    }
    print(f"{args.preset}, {os.cpu_count()} cores")
    print("| | frames/s, together |")
    print("| --- | --- |")
    for name, (runs, variables, options, busy) in arrangements.items():
        print(f"| {name} | {measure(runs, variables, options, busy, args):.0f} |", flush=True)


if __name__ == "__main__":
    main()
