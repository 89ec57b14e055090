"""Times what reads class ids by look-up and over one-hot maps: a convolution, and updates.

    python benchmarks/class_maps.py [--rounds 7] [--batch 128] [--side 48] [--classes 5]

The first convolution of the network alone, then updates of discrete SAC in float32; `depth2` is the
same network over two plain channels. One thread; CPU time, so that it can be measured beside other
work. All variants take turns in each round.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial
from unittest.mock import patch

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Categorical, Composite, TensorSpec, Unbounded
from update import interleaved

from flowrep.agent import DiscreteSAC, keep_freed_memory, use_threads
from flowrep.agent.class_convolution import ClassConvolution, one_hot
from flowrep.agent.convolution import Convolution
from flowrep.agent.observation import has_fast_bf16

ACTIONS, CHANNELS = 3, 2
FEATURES, BLOCK = 32, 4  # of the network's first convolution: 8 x 8 by 4, as 2 x 2 over blocks
STACKS = {"depth2": ["depth2"], "seg2": ["seg2"], "ego+obj+seg2": ["ego", "obj", "seg2"]}


class OneHotConvolution(Convolution):
    """A convolution over one-hot maps that are made for it."""

    def __init__(
        self, weight: Tensor, bias: Tensor, channels: int, dtype: torch.dtype = torch.float32
    ) -> None:
        super().__init__(weight, bias, 1, dtype)
        self.classes = weight.shape[1] // channels

    def __call__(self, ids: Tensor) -> Tensor:
        return super().__call__(one_hot(ids, self.classes, self.weight.dtype))

    def weight_gradient(self, g: Tensor, ids: Tensor) -> Tensor:
        return super().weight_gradient(g, one_hot(ids, self.classes, self.weight.dtype))


def layers_of(classes: int, side: int, maps: int) -> dict[str, Callable[[], object]]:
    """Returns both passes of the first convolution of some maps, by look-up and one-hot."""
    channels, pixels = CHANNELS * BLOCK**2, side // BLOCK
    ids = torch.randint(classes, (maps, channels, pixels, pixels), dtype=torch.uint8)
    ids = ids.contiguous(memory_format=torch.channels_last)
    weight, bias = torch.randn(FEATURES, channels * classes, 2, 2), torch.randn(FEATURES)
    layers = {
        "look-up, fp32": ClassConvolution(weight, bias, channels),
        "one-hot, fp32": OneHotConvolution(weight, bias, channels),
    }
    if has_fast_bf16(torch.device("cpu")):
        layers["one-hot, bf16"] = OneHotConvolution(weight, bias, channels, torch.bfloat16)
    passes: dict[str, Callable[[], object]] = {}
    for name, layer in layers.items():
        g = torch.randn_like(layer(ids))
        passes[f"{name}, forward"] = partial(layer, ids)
        passes[f"{name}, weight gradient"] = partial(layer.weight_gradient, g, ids)
    return passes


def update_of(
    names: list[str], classes: int, side: int, batch: int, *, looks_up: bool
) -> Callable[[], object]:
    """Returns an agent's update on random maps."""
    shape = (CHANNELS, side, side)
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
    cpu = torch.device("cpu")
    layers = layers_of(args.classes, args.side, 2 * args.batch)  # maps before and after a step
    updates = {}
    for stack, names in STACKS.items():
        updates[stack] = update_of(names, *sizes, looks_up=True)
        if "seg2" in names:
            updates[f"{stack}, one-hot"] = update_of(names, *sizes, looks_up=False)
    print(f"{args.side} x {args.side}, batch {args.batch}, {args.classes} classes, one thread")
    for title, variants in (("first convolution", layers), ("update", updates)):
        seconds = interleaved(variants, args.rounds, cpu, time.process_time)
        print(f"\n| {title} | ms |\n| --- | --- |")
        for name, taken in seconds.items():
            print(f"| {name} | {1000 * taken:.1f} |")


if __name__ == "__main__":
    main()
