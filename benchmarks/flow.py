"""Milliseconds for a step's raw, ego and object flow: PyTorch's passes, the kernel, torch.compile.

    python benchmarks/flow.py [--rounds 40]

One thread, CPU time; the contenders take turns. Every map shows six of 16 moving bodies on 5 % of
its pixels.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from unittest.mock import patch

import torch
from torch import Tensor

from flowrep.agent.algorithm import keep_freed_memory
from flowrep.geometry import factorize, rigid_flow
from flowrep.geometry import flow as flow_module

SIZES = [(32, 48), (96, 48), (32, 84), (128, 84)]
BODIES, SEEN = 16, 6


def step(depth: Tensor, instance: Tensor, K: Tensor, motions: Tensor) -> tuple[Tensor, ...]:
    """Returns raw, ego and object flow, as RawFlow and FlowFactorize compute them."""
    raw = rigid_flow(depth, instance, K, motions)
    return (raw.flow, *factorize(raw, depth, K, motions[:, 0])[:2])


def by_pytorch(*inputs: Tensor) -> tuple[Tensor, ...]:
    """Returns the same without the kernel."""
    with patch.object(flow_module, "SMALL", 1 << 40):
        return step(*inputs)


def inputs(maps: int, side: int) -> tuple[Tensor, ...]:
    """Returns depth, ids, K and motions."""
    depth = 1 + 30 * torch.rand(maps, 1, side, side)
    instance = torch.zeros(maps, 1, side, side, dtype=torch.uint8)
    wide = max(1, side // 30)
    for body in range(SEEN):
        instance[:, :, side // 3 : 2 * side // 3, body * side // SEEN :][..., :wide] = body + 1
    K = torch.tensor([[0.87 * side, 0, side / 2], [0, 0.87 * side, side / 2], [0, 0, 1]])
    motions = torch.eye(4).repeat(maps, 1 + BODIES, 1, 1)
    motions[..., :3, 3] = 0.3 * torch.rand(maps, 1 + BODIES, 3)
    return depth, instance, K, motions


def cpu_ms(call: Callable[..., object], given: Sequence[Tensor]) -> float:
    """Returns the CPU time of one call."""
    started = time.process_time()
    call(*given)
    return 1e3 * (time.process_time() - started)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=40)
    args = parser.parse_args()
    keep_freed_memory()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    print("| maps | PyTorch | kernel | torch.compile |")
    print("| --- | --- | --- | --- |")
    for maps, side in SIZES:
        given = inputs(maps, side)
        contenders = [by_pytorch, step, torch.compile(step, dynamic=False)]
        reference = by_pytorch(*given)
        if not all(map(torch.equal, step(*given), reference)):
            raise SystemExit("the kernel's flow differs from PyTorch's")
        for contender in contenders:
            contender(*given)
        turns = [[cpu_ms(call, given) for call in contenders] for _ in range(args.rounds)]
        cells = " | ".join(f"{statistics.median(times):.2f}" for times in zip(*turns))
        print(f"| {maps} × {side} × {side} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
