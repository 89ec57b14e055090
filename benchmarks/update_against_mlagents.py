"""Times flowrep's update against the paper's trainer, ML-Agents, as its PyPI package computes it.

    python3.11 -m venv /tmp/mlagents
    /tmp/mlagents/bin/pip install torch==2.13.0 'numpy<2' 'cattrs==23.2.3' attrs 'protobuf<3.21' \\
        grpcio pyyaml tensorboard h5py cloudpickle filelock 'setuptools<70'
    /tmp/mlagents/bin/pip install --no-deps mlagents==0.28.0 mlagents_envs==0.28.0
    python benchmarks/update_against_mlagents.py /tmp/mlagents/bin/python

All take turns in one run, with the same map and batch sizes: ML-Agents has five separate networks
in float32, flowrep one or two sets of encoders. ML-Agents runs twice: by default, and with glibc's
allocator configured as in flowrep (GLIBC_TUNABLES).
"""

import argparse
import os
import subprocess
import time
from pathlib import Path

import torch
from update import (
    CHANNELS,
    MAPS,
    SIZES,
    dtypes_of,
    flowrep_update,
    interleaved,
    random_steps,
    stock_update,
)

from flowrep.agent import keep_freed_memory

_LIMIT = 4 << 30
KEEPING = {
    "GLIBC_TUNABLES": f"glibc.malloc.mmap_threshold={_LIMIT}:glibc.malloc.trim_threshold={_LIMIT}"
}


class Rival:
    """ML-Agents in a separate process that makes an update on request."""

    def __init__(self, python: str, side: int, batch: int, environment: dict[str, str]) -> None:
        worker = Path(__file__).with_name("mlagents_worker.py")
        self.process = subprocess.Popen(
            [python, str(worker), str(side), str(batch), str(torch.get_num_threads())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | environment,
        )
        while (line := self.process.stdout.readline()).strip() != "ready":
            if not line:
                raise SystemExit("ML-Agents did not start: see its messages above")

    def __call__(self) -> None:
        self.process.stdin.write("update\n")
        self.process.stdin.flush()
        float(self.process.stdout.readline())

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("python", help="of the environment that has mlagents")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=[*SIZES])
    args = parser.parse_args()
    device = torch.device("cpu")
    keep_freed_memory()
    for size in args.sizes:
        side, batch = SIZES[size]
        torch.manual_seed(0)
        steps = random_steps(side, batch, device)
        rivals = {
            "ML-Agents, out of the box": Rival(args.python, side, batch, {}),
            "ML-Agents, freed memory kept": Rival(args.python, side, batch, KEEPING),
        }
        fastest = next(iter(dtypes_of(device)))
        updates = {
            f"flowrep {encoder} {fastest}": flowrep_update(steps, encoder, fastest)
            for encoder in ("shared", "separate")
        }
        updates["TorchRL stock, separate fp32"] = stock_update(steps)
        seconds = interleaved(rivals | updates, args.rounds, device, time.perf_counter)
        for rival in rivals.values():
            rival.close()
        print(f"\n{size}: {side}x{side}, {len(MAPS)} maps of {CHANNELS} channels, batch {batch}, ")
        print(f"{torch.get_num_threads()} threads, median of {args.rounds} rounds")
        print("| update | s | faster than ML-Agents out of the box | freed memory kept |")
        print("| --- | --- | --- | --- |")
        for name, value in seconds.items():
            ratios = (f"{seconds[rival] / value:.1f}" for rival in rivals)
            print(f"| {name} | {value:.3f} | {' | '.join(ratios)} |", flush=True)


if __name__ == "__main__":
    main()
