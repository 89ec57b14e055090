"""Times updates that read class ids, by look-up and over one-hot maps.

    python benchmarks/class_maps.py [--rounds 7] [--batch 128] [--side 48] [--classes 5]

Discrete SAC on one thread in float32; CPU time, so that it can be measured beside other work. All
variants take turns in each round. `depth2` is the same network over two plain channels.
"""

import argparse
import time
from collections.abc import Callable
from unittest.mock import patch

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Categorical, Composite, TensorSpec, Unbounded
from update import interleaved

from flowrep.agent import DiscreteSAC, keep_freed_memory, use_threads
from flowrep.agent.class_convolution import one_hot
from flowrep.agent.convolution import Convolution

ACTIONS = 3
STACKS = {"depth2": ["depth2"], "seg2": ["seg2"], "ego+obj+seg2": ["ego", "obj", "seg2"]}


class OneHotConvolution(Convolution):
    """A convolution over one-hot maps that are made for it."""

    def __init__(self, weight: Tensor, bias: Tensor, channels: int) -> None:
        super().__init__(weight, bias, 1, torch.float32)
        self.classes = weight.shape[1] // channels

    def __call__(self, ids: Tensor) -> Tensor:
        return super().__call__(one_hot(ids, self.classes, torch.float32))

    def weight_gradient(self, g: Tensor, ids: Tensor) -> Tensor:
        return super().weight_gradient(g, one_hot(ids, self.classes, torch.float32))


def update_of(
    names: list[str], classes: int, side: int, batch: int, *, looks_up: bool
) -> Callable[[], object]:
    """Returns an agent's update on random maps."""
    shape = (2, side, side)
    specs: dict[str, TensorSpec] = {name: Unbounded(shape) for name in names}
    if "seg2" in names:
        specs["seg2"] = Categorical(classes, shape, dtype=torch.uint8)
    agent = DiscreteSAC(
        Composite(specs), Categorical(ACTIONS), names, total_frames=10**9, batch_size=batch,
        replay_capacity=2 * batch, precision="fp32",
    )  # fmt: skip
    ends = torch.ones(batch, 1, dtype=torch.bool)

    def maps() -> dict[str, Tensor]:
        return {
            name: torch.stack([spec.rand() for _ in range(batch)]) for name, spec in specs.items()
        }

    following = {**maps(), "reward": torch.randn(batch, 1), "done": ends, "terminated": ends}
    seen = {**maps(), "action": torch.randint(ACTIONS, (batch,)), "is_init": ends}
    agent.memory.extend(TensorDict({**seen, "next": following}, [batch]))
    sample = agent.sample()
    if looks_up:
        return lambda: agent.update(sample)

    def update() -> None:
        with patch("flowrep.agent.layers.ClassConvolution", OneHotConvolution):
            agent.update(sample)

    return update


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--side", type=int, default=48)
    parser.add_argument("--classes", type=int, default=5, help="Straight Road has 5, others to 11")
    args = parser.parse_args()
    sizes = args.classes, args.side, args.batch
    torch.set_num_threads(1)
    use_threads(1)
    keep_freed_memory()
    torch.manual_seed(0)
    updates = {}
    for stack, names in STACKS.items():
        updates[stack] = update_of(names, *sizes, looks_up=True)
        if "seg2" in names:
            updates[f"{stack}, one-hot"] = update_of(names, *sizes, looks_up=False)
    seconds = interleaved(updates, args.rounds, torch.device("cpu"), time.process_time)
    print(f"{args.side} x {args.side}, batch {args.batch}, {args.classes} classes, one thread")
    print("| update | ms |\n| --- | --- |")
    for name, taken in seconds.items():
        print(f"| {name} | {1000 * taken:.1f} |")


if __name__ == "__main__":
    main()
