"""Measures the parts of training on a GPU, and projects the time of the paper's run.

    python benchmarks/gpu.py [--output outputs/gpu] [--rounds 20] [--parts update transforms ...]

Four parts, each a table: an update (as a CUDA graph and eager, bf16 and fp32, against TorchRL's
stock recipe and the floor at the measured rate of matrix products), factorising flow (against
kornia, if installed, and a copy), frames per second of the envs by number of worker processes, and
a short training at the paper's size, from which the wall time of the full one is projected. The
report is printed, and written to report.md and report.json after every part. `--device cpu --quick`
runs a tiny version of everything, whose numbers are meaningless.
"""

import argparse
import json
import logging
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from factorize import BYTES_PER_PIXEL, copier, cuda_clock, inputs, kornia_factorize
from factorize import repeats_for as repeats_for_a_turn
from factorize import timed as seconds_of_a_call
from frames import in_size, stepper
from training import train
from update import (
    SIZES,
    STOCK,
    flowrep_update,
    interleaved,
    matrix_product,
    operations,
    random_steps,
    stock_update,
)

from flowrep.envs import make_env
from flowrep.geometry import factorize

FACTORIZE_SIZES = [(64, 84, 84), (1024, 84, 84), (1, 720, 1280)]
PAPER_FRAMES = 2_000_000
WORKERS, NUM_ENVS, SIDE = (0, 1, 4, 8, 16), 32, 84
NO_GPU = 2  # the exit code


@dataclass
class Part:
    """One table of the report and its notes."""

    title: str
    rows: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def markdown(self) -> str:
        lines = [f"## {self.title}", "", *(f"{note}\n" for note in self.notes)]
        columns = list(dict.fromkeys(name for row in self.rows for name in row))
        lines += [f"| {' | '.join(columns)} |", f"|{' --- |' * len(columns)}"]
        for row in self.rows:
            lines.append(f"| {' | '.join(text_of(row.get(name)) for name in columns)} |")
        return "\n".join([*lines, ""])


def text_of(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def updates(args: argparse.Namespace) -> Part:
    """Measures updates by size, encoder, precision and whether they are CUDA graphs."""
    part = Part("An update of discrete SAC")
    if args.device.type != "cuda":
        part.notes.append("There are no graphs on a CPU: both kinds are eager here.")
    for name, (side, batch) in ({"tiny": (40, 8)} if args.quick else SIZES).items():
        torch.manual_seed(0)
        steps = random_steps(side, batch, args.device)
        variants = {
            f"{encoder} {precision}, {kind}": flowrep_update(
                steps, encoder, precision, eager=kind == "eager"
            )
            for encoder in ("shared", "separate")
            for precision in ("bf16", "fp32")
            for kind in ("graph", "eager")
        }
        counts = {variant: operations(update) for variant, update in variants.items()}
        width = 256 if args.quick else 8192
        types = {"bf16 products": torch.bfloat16, "fp32 products": torch.float32}
        products = {n: matrix_product(dtype, args.device, width) for n, dtype in types.items()}
        everything = {**variants, STOCK: stock_update(steps), **products}
        seconds = interleaved(everything, args.rounds, args.device, time.perf_counter)
        rates = {n: 2 * width**3 / seconds[n] for n in products}
        for variant in (*variants, STOCK):
            row = {"size": name, "update": variant, "ms": 1e3 * seconds[variant]}
            if variant in counts:
                floor = counts[variant] / rates["bf16 products"]
                row |= {"bf16 floor, ms": 1e3 * floor, "x floor": seconds[variant] / floor}
            row["x faster than stock"] = seconds[STOCK] / seconds[variant]
            part.rows.append(row)
        measured = ", ".join(f"{n} {rate / 1e12:.4g} TFLOP/s" for n, rate in rates.items())
        part.notes.append(f"{name}: {side}x{side}, batch {batch}; {measured}.")
    return part


@torch.no_grad()
def transforms(args: argparse.Namespace) -> Part:
    """Measures factorising flow beside kornia and a copy."""
    part = Part("Factorising flow, float32")
    clock = cuda_clock if args.device.type == "cuda" else time.perf_counter
    copied_bytes = 2**20 if args.quick else 2**30
    copy = copier(copied_bytes, args.device)
    has_kornia = find_spec("kornia") is not None
    if not has_kornia:
        part.notes.append("kornia is not installed: pip install kornia for its column.")
    if args.quick:
        part.notes.append("Nothing is compiled in the quick version.")
    for batch, height, width in [(2, 12, 16)] if args.quick else FACTORIZE_SIZES:
        given = [tensor.to(args.device) for tensor in inputs(batch, height, width)]
        compiled = torch.compile(factorize, backend="eager" if args.quick else "inductor")
        calls: dict[str, Callable[..., Any]] = {"compiled": compiled, "eager": factorize}
        if has_kornia:
            calls["kornia"] = kornia_factorize
        seconds = {n: seconds_of(partial(call, *given), clock) for n, call in calls.items()}
        moved = batch * height * width * BYTES_PER_PIXEL
        bandwidth = copied_bytes / seconds_of(copy, clock)
        row = {"size": f"{batch} x {height} x {width}"}
        row |= {f"{name}, ms": 1e3 * s for name, s in seconds.items()}
        row |= {"copy, GB/s": bandwidth / 1e9, "of it": moved / seconds["compiled"] / bandwidth}
        if has_kornia:
            row["x kornia"] = seconds["kornia"] / seconds["compiled"]
        part.rows.append(row)
    return part


def seconds_of(call: Callable[[], object], clock: Callable[[], float]) -> float:
    call()  # compiles
    return seconds_of_a_call(call, repeats_for_a_turn(call, clock), clock)


def envs(args: argparse.Namespace) -> Part:
    """Measures frames per second by number of worker processes; 0 is this process alone."""
    part = Part("Envs with ego and obj, random actions")
    num_envs, side, steps = (2, 40, 3) if args.quick else (NUM_ENVS, SIDE, 60)
    clock = cuda_clock if args.device.type == "cuda" else time.perf_counter
    for workers in (0, 1) if args.quick else WORKERS:
        env = make_env(
            in_size("straight_road", side), ("ego", "obj"), num_envs=num_envs,
            num_workers=workers, device=args.device, seed=0,
        )  # fmt: skip
        take = stepper(env, clock)
        take(steps)  # warms up
        rate = 1e3 / take(steps)
        env.close()
        part.rows.append({"workers": workers, "num_envs": num_envs, "frames/s": rate})
    return part


def whole_training(args: argparse.Namespace) -> Part:
    """Projects the time of the paper's 2,000,000 frames, without evaluations."""
    size = ["debug=smoke"] if args.quick else ["preset=paper", "total_frames=20_000"]
    found = train(*size, f"device={args.device}")
    rate = found["frames_per_second"]
    row = {"frames/s": rate, f"min for {PAPER_FRAMES:,}": PAPER_FRAMES / rate / 60}
    row["outside updates"] = found["share_outside_updates"]
    note = "Shares are of the host's time; kernels count where something waited for them."
    return Part("A training at the paper's size, projected", [row], [note])


PARTS = {"update": updates, "transforms": transforms, "envs": envs, "training": whole_training}


def write(folder: Path, machine: str, parts: dict[str, Part]) -> str:
    """Writes the finished parts of the report; returns them as Markdown."""
    folder.mkdir(parents=True, exist_ok=True)
    text = "\n".join([f"# {machine}\n", *(part.markdown() for part in parts.values())])
    (folder / "report.md").write_text(text, encoding="utf-8")
    document = {"machine": machine, **{name: asdict(part) for name, part in parts.items()}}
    (folder / "report.json").write_text(json.dumps(document, indent=1), encoding="utf-8")
    return text


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", type=torch.device, default=torch.device("cuda"))
    parser.add_argument("--output", type=Path, default=Path("outputs/gpu"))
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=[*PARTS])
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to try the script")
    args = parser.parse_args(argv)
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces each storage, on stdout
    if args.device.type == "cuda" and not torch.cuda.is_available():
        print("no CUDA device here; --device cpu --quick tries the script", file=sys.stderr)
        sys.exit(NO_GPU)
    name = torch.cuda.get_device_name(args.device) if args.device.type == "cuda" else "CPU"
    machine = f"{name}, {torch.get_num_threads()} CPU threads, torch {torch.__version__}"
    parts: dict[str, Part] = {}
    for part in args.parts:
        print(f"measuring: {part}", file=sys.stderr, flush=True)
        parts[part] = PARTS[part](args)
        text = write(args.output, machine, parts)
    print(text)


if __name__ == "__main__":
    main()
