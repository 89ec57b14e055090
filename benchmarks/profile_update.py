"""A breakdown of the time of a gradient step of discrete SAC, beside each part's floor.

    python benchmarks/profile_update.py [--size paper] [--encoder shared] [--rounds 9]

Every operation is timed on its own while the update runs. Its floor is the larger of two times: its
arithmetic at the machine's measured rate of matrix products in its dtype, and the bytes that it
reads and writes at the measured bandwidth of a copy. The rest of the update's time, measured
without profiling, is spent between the operations: Python, autograd, dispatch.
"""

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry
from update import SIZES, dtypes_of, flowrep_agent, matrix_product, random_steps

from flowrep.agent import keep_freed_memory

LAYER_OF_KERNEL = {2: "conv 1 (2x2 over packed blocks)", 4: "conv 2", 3: "conv 3"}
GROUPS = {
    "aten::addmm": "linear layers, forward",
    "aten::mm": "linear layers, backward",
    "aten::_to_copy": "casts and copies",
    "aten::copy_": "casts and copies",
    "aten::clone": "casts and copies",
    "aten::leaky_relu_": "activations",
    "aten::leaky_relu_backward": "activations",
    "aten::silu": "activations",
    "aten::silu_backward": "activations",
    "aten::cat": "stacking the heads' gradients",
    "aten::stack": "stacking the heads' gradients",
    "aten::_fused_adam_": "Adam",
    "aten::_foreach_lerp_": "moving the targets",
    "aten::_foreach_norm": "gradient norm",
    "aten::linalg_vector_norm": "gradient norm",
    "aten::index_select": "drawing the batch",
}
FREE = ("detach", "alias", "unbind")


@dataclass
class Cost:
    """The measured cost of one group of calls, and its lower bound."""

    calls: int = 0
    seconds: float = 0.0
    operations: int = 0
    bytes: int = 0
    floor_seconds: float = 0.0


class OperationTimer(TorchDispatchMode):
    """Adds up the costs of all operations by group."""

    def __init__(self, rates: dict[torch.dtype, float], bytes_per_second: float) -> None:
        super().__init__()
        self.rates, self.bytes_per_second = rates, bytes_per_second
        self.costs: dict[str, Cost] = defaultdict(Cost)

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        start = time.perf_counter()
        out = func(*args, **kwargs)
        seconds = time.perf_counter() - start
        cost = self.costs[group(func, args)]
        cost.calls += 1
        cost.seconds += seconds
        if func.is_view or func._schema.name.removeprefix("aten::") in FREE:
            return out
        count = flop_registry.get(func.overloadpacket)
        operations = count(*args, **kwargs, out_val=out) if count else 0
        tensors = [x for x in tree_leaves((args, kwargs, out)) if isinstance(x, torch.Tensor)]
        moved = sum({x.data_ptr(): x.nbytes for x in tensors}.values())
        dtypes = [x.dtype for x in tensors if x.dtype in self.rates] or [torch.float32]
        cost.operations += operations
        cost.bytes += moved
        cost.floor_seconds += max(operations / self.rates[dtypes[0]], moved / self.bytes_per_second)
        return out


def group(func: Any, args: tuple[Any, ...]) -> str:
    name = func._schema.name
    if name == "aten::convolution":
        return f"{LAYER_OF_KERNEL[args[1].shape[-1]]}, forward"
    if name == "aten::convolution_backward":
        return f"{LAYER_OF_KERNEL[args[2].shape[-1]]}, backward"
    return GROUPS.get(name, "everything else")


def median_seconds(act: Callable[[], object], rounds: int) -> float:
    seconds = []
    for turn in range(rounds + 2):
        start = time.perf_counter()
        act()
        if turn >= 2:  # the first two warm up
            seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", choices=SIZES, default="paper")
    parser.add_argument("--encoder", choices=("shared", "separate"), default="shared")
    parser.add_argument("--precision", choices=("auto", "bf16", "fp32"), default="auto")
    parser.add_argument("--rounds", type=int, default=9)
    args = parser.parse_args()
    keep_freed_memory()
    torch.manual_seed(0)
    device, (side, batch) = torch.device("cpu"), SIZES[args.size]
    rates = {
        dtype: 2 * 2048**3 / median_seconds(matrix_product(dtype, device, 2048), args.rounds)
        for dtype in dtypes_of(device).values()
    }
    block = torch.empty(1 << 28, dtype=torch.uint8)
    target = torch.empty_like(block)
    bandwidth = 2 * block.nbytes / median_seconds(lambda: target.copy_(block), args.rounds)
    agent = flowrep_agent(random_steps(side, batch, device), args.encoder, args.precision)

    def draw_and_update() -> None:
        agent.update(agent.sample())

    whole = median_seconds(draw_and_update, args.rounds)
    print(
        f"{args.size}: {side}x{side}, batch {batch}, {args.encoder}, {args.precision}, "
        f"{torch.get_num_threads()} threads; products "
        + ", ".join(f"{dtype} {rate / 1e9:.0f} GFLOP/s" for dtype, rate in rates.items())
        + f"; copies {bandwidth / 1e9:.1f} GB/s"
    )
    timed = []
    for _ in range(args.rounds):
        timer = OperationTimer(rates, bandwidth)
        with timer:
            draw_and_update()
        timed.append(timer.costs)
    print_table(timed, whole)


def print_table(timed: list[dict[str, Cost]], whole: float) -> None:
    """Prints each group's median over several updates, the largest first."""
    seconds = {name: statistics.median(c[name].seconds for c in timed) for name in timed[0]}
    print("| where | calls | ms | GFLOP | MB | floor, ms | x floor |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in sorted(seconds, key=seconds.__getitem__, reverse=True):
        cost = timed[-1][name]
        print(
            f"| {name} | {cost.calls} | {1e3 * seconds[name]:.2f} | {cost.operations / 1e9:.1f} | "
            f"{cost.bytes / 1e6:.0f} | {1e3 * cost.floor_seconds:.2f} | "
            f"{seconds[name] / max(cost.floor_seconds, 1e-9):.1f} |"
        )
    floor = sum(cost.floor_seconds for cost in timed[-1].values())
    between = whole - sum(seconds.values())
    print(f"| between the operations | | {1e3 * between:.2f} | | | | |")
    print(f"| **the update** | | {1e3 * whole:.2f} | | | {1e3 * floor:.2f} | {whole / floor:.2f} |")


if __name__ == "__main__":
    main()
