"""Times a gradient step of discrete SAC against TorchRL's stock recipe and the machine's floor.

    python benchmarks/update.py [--device cuda] [--rounds 5] [--threads 2] [--default-malloc]
        [--busy]

All variants learn from the same transitions; each round times every variant once, in turn, and the
machine's matrix products between them, so that a change of load affects all alike. The floor is the
update's own count of operations at the highest measured rate of products. A CPU without
instructions for bfloat16 is measured in float32 alone. `--default-malloc` keeps glibc's default
allocator settings, to show the effect of `keep_freed_memory`. For machines under other load,
`--busy` runs on one thread and measures CPU time instead of wall time.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.utils.flop_counter import FlopCounterMode
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import DiscreteSACLoss, SoftUpdate

from flowrep.agent import DiscreteSAC, keep_freed_memory
from flowrep.agent.algorithm import WARM_UP
from flowrep.agent.observation import has_fast_bf16

MAPS = ("ego", "obj")
CHANNELS, ACTIONS = 2, 3
SIZES = {"laptop": (48, 128), "paper": (84, 1024)}  # pixels a side, batch


def random_steps(side: int, batch: int, device: torch.device) -> TensorDict:
    """Returns steps that all terminate, so that each is a complete transition."""

    def maps() -> dict[str, torch.Tensor]:
        return {name: torch.randn(batch, CHANNELS, side, side, device=device) for name in MAPS}

    ends = torch.ones(batch, 1, dtype=torch.bool, device=device)
    reward = torch.randn(batch, 1, device=device)
    following = {**maps(), "reward": reward, "done": ends, "terminated": ends}
    action = torch.randint(ACTIONS, (batch,), device=device)
    seen = {**maps(), "action": action, "is_init": ends}
    return TensorDict({**seen, "next": following}, [batch], device=device)


def agent_for(
    spec: Composite, actions: Categorical, keys: Sequence[str], **changes: object
) -> DiscreteSAC:
    """Returns discrete SAC with the paper's hyperparameters."""
    return DiscreteSAC(spec, actions, list(keys), total_frames=10**9, **changes)


def dtypes_of(device: torch.device) -> dict[str, torch.dtype]:
    """Returns the precisions worth measuring: emulated bfloat16 takes minutes for an update."""
    fast = {"bf16": torch.bfloat16} if has_fast_bf16(device) else {}
    return fast | {"fp32": torch.float32}


def flowrep_agent(steps: TensorDict, encoder: str, precision: str) -> DiscreteSAC:
    """Returns an agent that has stored these steps and learns from all of them at once."""
    side, batch = steps["ego"].shape[-1], len(steps)
    spec = Composite({name: Unbounded((CHANNELS, side, side)) for name in MAPS})
    agent = agent_for(
        spec, Categorical(ACTIONS), MAPS, device=steps.device, encoder=encoder,
        precision=precision, batch_size=batch, replay_capacity=2 * batch,
    )  # fmt: skip
    agent.memory.extend(steps)
    return agent


def flowrep_update(
    steps: TensorDict, encoder: str, precision: str, *, eager: bool = False
) -> Callable[[], object]:
    agent = flowrep_agent(steps, encoder, precision)
    if eager:
        agent.step_eagerly()
    sample = agent.sample()
    return lambda: agent.update(sample)


class StockNetwork(nn.Module):
    """A plain network: Nature encoders, a hidden layer and one output for each action."""

    def __init__(self, side: int) -> None:
        super().__init__()
        final = ((((side - 8) // 4 + 1) - 4) // 2 + 1) - 2
        self.encoders = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(CHANNELS, 32, 8, 4), nn.LeakyReLU(), nn.Conv2d(32, 64, 4, 2),
                nn.LeakyReLU(), nn.Conv2d(64, 64, 3), nn.LeakyReLU(), nn.Flatten(-3),
                nn.Linear(64 * final * final, 512), nn.LeakyReLU(),
            )
            for _ in MAPS
        )  # fmt: skip
        self.head = nn.Sequential(
            nn.Linear(512 * len(MAPS), 512), nn.SiLU(), nn.Linear(512, ACTIONS)
        )

    def forward(self, *maps: torch.Tensor) -> torch.Tensor:
        return self.head(torch.cat([encode(x) for encode, x in zip(self.encoders, maps)], -1))


def stock_update(steps: TensorDict) -> Callable[[], object]:
    """Returns an update of TorchRL's `DiscreteSACLoss` as in its examples, in float32."""
    side = steps["ego"].shape[-1]
    with torch.device(steps.device):
        actor = TensorDictModule(StockNetwork(side), in_keys=[*MAPS], out_keys=["logits"])
        critic = TensorDictModule(StockNetwork(side), in_keys=[*MAPS], out_keys=["action_value"])
    policy = ProbabilisticActor(
        actor, in_keys=["logits"], distribution_class=torch.distributions.Categorical
    )
    loss = DiscreteSACLoss(
        policy, critic, action_space="categorical", num_actions=ACTIONS, loss_function="l2",
        alpha_init=0.5, target_entropy_weight=0.2,
    )  # fmt: skip
    loss.make_value_estimator(gamma=0.99)
    targets = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)

    def update() -> None:
        losses = loss(steps)
        (losses["loss_qvalue"] + losses["loss_actor"] + losses["loss_alpha"]).backward()
        optimizer.step()
        optimizer.zero_grad()
        targets.step()

    return update


def matrix_product(dtype: torch.dtype, device: torch.device, side: int) -> Callable[[], object]:
    a = torch.randn(side, side, dtype=dtype, device=device)
    return lambda: a @ a


def interleaved(
    actions: dict[str, Callable[[], object]],
    rounds: int,
    device: torch.device,
    clock: Callable[[], float],
) -> dict[str, float]:
    """Returns each function's median seconds over rounds in which all take turns."""
    seconds: dict[str, list[float]] = {name: [] for name in actions}
    for turn in range(rounds + WARM_UP):
        for name, act in actions.items():
            start = clock()
            act()
            if device.type == "cuda":
                torch.cuda.synchronize()
            if turn >= WARM_UP:
                seconds[name].append(clock() - start)
    return {name: statistics.median(values) for name, values in seconds.items()}


class NoModules:
    """Replaces PyTorch's module tracker, which fails on the modules of a LossModule.

    See docs/upstream.md; only the total is needed.
    """

    parents = ("Global",)

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...


def operations(update: Callable[[], object]) -> int:
    counter = FlopCounterMode(display=False)
    counter.mod_tracker = NoModules()
    with counter:
        update()
    return counter.get_total_flops()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=[*SIZES])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--default-malloc", action="store_true")
    parser.add_argument("--busy", action="store_true")
    args = parser.parse_args()
    clock = time.process_time if args.busy else time.perf_counter
    threads = 1 if args.busy else args.threads
    torch.set_num_threads(threads)
    kept = not args.default_malloc and keep_freed_memory()
    print(f"{args.device}, {torch.get_num_threads()} threads, freed memory kept: {kept}")
    for size in args.sizes:
        side, batch = SIZES[size]
        torch.manual_seed(0)
        steps = random_steps(side, batch, args.device)
        dtypes = dtypes_of(args.device)
        updates = {
            f"flowrep {encoder} {precision}": flowrep_update(steps, encoder, precision)
            for precision in dtypes
            for encoder in ("shared", "separate")
        }
        updates["TorchRL stock, separate fp32"] = stock_update(steps)
        width = 8192 if args.device.type == "cuda" else 2048
        products = {n: matrix_product(t, args.device, width) for n, t in dtypes.items()}
        # counted first: operations inside a CUDA graph are invisible later
        counts = {n: None if "stock" in n else operations(u) for n, u in updates.items()}
        seconds = interleaved({**updates, **products}, args.rounds, args.device, clock)
        rates = {name: 2 * width**3 / seconds[name] for name in products}
        print(f"\n{size}: {side}x{side}, {len(MAPS)} maps of {CHANNELS} channels, batch {batch}")
        print(", ".join(f"{n} products {r / 1e9:.0f} GFLOP/s" for n, r in rates.items()))
        print("| update | s | GFLOP | floor, s | x floor | faster than stock |")
        print("| --- | --- | --- | --- | --- | --- |")
        stock = seconds["TorchRL stock, separate fp32"]
        for name, count in counts.items():
            floor = count / max(rates.values()) if count else None
            columns = [
                f"{seconds[name]:.4f}",
                f"{count / 1e9:.1f}" if count else "",
                f"{floor:.4f}" if floor else "",
                f"{seconds[name] / floor:.2f}" if floor else "",
                f"{stock / seconds[name]:.1f}",
            ]
            print(f"| {name} | " + " | ".join(columns) + " |")


if __name__ == "__main__":
    main()
