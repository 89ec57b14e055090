"""Times a gradient step of discrete SAC beside plain PyTorch, TorchRL's recipe and the floor.

    python benchmarks/update.py [--device cuda] [--rounds 5] [--threads 2] [--cpu-time]

All variants learn from the same transitions and take turns, as do matrix products, so that a change
of load affects all alike. The floor is the time that the update's operations would take at the
highest measured rate of the products. "Plain" is the same update with a shared encoder, written
without TorchRL. A CPU without instructions for bfloat16 is measured in float32 only.
`--default-malloc` keeps glibc's default allocator settings, to show the effect of
`keep_freed_memory`. `--cpu-time` runs on one thread and measures CPU time, for a busy machine.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.utils.flop_counter import FlopCounterMode
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import DiscreteSACLoss, SoftUpdate

from flowrep.agent import DiscreteSAC, keep_freed_memory
from flowrep.agent.cuda_graph import WARM_UP
from flowrep.agent.precision import has_bf16
from flowrep.config.algorithms import DiscreteSACOptions

MAPS = ("ego", "obj")
CHANNELS, ACTIONS = 2, 3
GAMMA, TAU, TARGET_ENTROPY_WEIGHT = 0.99, 0.005, 0.2
# (height and width in pixels, batch); "tiny" is for tests of the script
SIZES = {
    "48 px, batch 128": (48, 128), "48 px, batch 256": (48, 256), "paper": (84, 1024),
    "tiny": (40, 8),
}  # fmt: skip
STOCK = "TorchRL stock, separate fp32"


def random_steps(side: int, batch: int, device: torch.device) -> TensorDict:
    """Returns `[batch]` steps that all terminate, so that each is a complete transition."""

    def maps() -> dict[str, torch.Tensor]:
        return {name: torch.randn(batch, CHANNELS, side, side, device=device) for name in MAPS}

    ends = torch.ones(batch, 1, dtype=torch.bool, device=device)
    reward = torch.randn(batch, 1, device=device)
    following = {**maps(), "reward": reward, "done": ends, "terminated": ends}
    action = torch.randint(ACTIONS, (batch,), device=device)
    seen = {**maps(), "action": action, "is_init": ends}
    return TensorDict({**seen, "next": following}, [batch], device=device)


def dtypes_of(device: torch.device) -> dict[str, torch.dtype]:
    """Returns float32, and bfloat16 unless it is emulated, which takes minutes for an update."""
    fast = {"bf16": torch.bfloat16} if has_bf16(device) else {}
    return fast | {"fp32": torch.float32}


def flowrep_update(
    steps: TensorDict, encoder: str, precision: str, *, eager: bool = False
) -> Callable[[], object]:
    """Returns an update of an agent that has stored these steps and learns from all at once."""
    side, batch = steps["ego"].shape[-1], len(steps)
    spec = Composite({name: Unbounded((CHANNELS, side, side)) for name in MAPS})
    options = DiscreteSACOptions(
        encoder=encoder, precision=precision, batch_size=batch, replay_capacity=2 * batch
    )
    agent = DiscreteSAC(
        spec, Categorical(ACTIONS), list(MAPS), options, total_frames=10**9, device=steps.device
    )
    agent.memory.extend(steps)
    if eager:
        agent.step_eagerly()
    sample = agent.sample()
    return lambda: agent.update(sample)


def nature(side: int) -> nn.Sequential:
    """Returns the convolutions of the DQN paper: 8/4, 4/2, 3/1, without padding."""
    final = ((((side - 8) // 4 + 1) - 4) // 2 + 1) - 2
    return nn.Sequential(
        nn.Conv2d(CHANNELS, 32, 8, 4), nn.LeakyReLU(), nn.Conv2d(32, 64, 4, 2), nn.LeakyReLU(),
        nn.Conv2d(64, 64, 3), nn.LeakyReLU(), nn.Flatten(-3),
        nn.Linear(64 * final * final, 512), nn.LeakyReLU(),
    )  # fmt: skip


def head(outputs: int, hidden: int = 512) -> nn.Sequential:
    return nn.Sequential(nn.Linear(512 * len(MAPS), hidden), nn.SiLU(), nn.Linear(hidden, outputs))


class Network(nn.Module):
    """Nature encoders, a hidden layer and one output for each action."""

    def __init__(self, side: int, outputs: int = ACTIONS, hidden: int = 512) -> None:
        super().__init__()
        self.encoders = nn.ModuleList(nature(side) for _ in MAPS)
        self.head = head(outputs, hidden)

    def embed(self, maps: Sequence[torch.Tensor]) -> torch.Tensor:
        return torch.cat([encode(x) for encode, x in zip(self.encoders, maps)], -1)

    def forward(self, *maps: torch.Tensor) -> torch.Tensor:
        return self.head(self.embed(maps))


def plain_update(steps: TensorDict, dtype: torch.dtype) -> Callable[[], object]:
    """Returns the shared-encoder update in plain PyTorch; both Qs are one head of twice the width.

    In this head, each Q also reads the other's hidden units, which makes the last layer a little
    more expensive.
    """
    side, device = steps["ego"].shape[-1], steps.device
    with torch.device(device):
        critic = Network(side, 2 * ACTIONS, 1024).to(memory_format=torch.channels_last)
        target = Network(side, 2 * ACTIONS, 1024).to(memory_format=torch.channels_last)
        actor, log_alpha = head(ACTIONS), torch.tensor(-0.7, requires_grad=True)
    weights = [*critic.parameters(), *actor.parameters(), log_alpha]
    optimizer = torch.optim.Adam(weights, lr=3e-4, fused=True)
    maps, following = (
        [x[name].to(dtype, memory_format=torch.channels_last) for name in MAPS]
        for x in (steps, steps["next"])
    )
    action = steps["action"].unsqueeze(-1)
    reward, ended = (steps["next", name].squeeze(-1) for name in ("reward", "terminated"))
    target_entropy = TARGET_ENTROPY_WEIGHT * torch.tensor(ACTIONS, device=device).log()

    def two(q: torch.Tensor) -> torch.Tensor:  # [B, 2 A] to [B, 2, A]
        return q.float().unflatten(-1, (2, ACTIONS))

    def update() -> None:
        alpha = log_alpha.detach().exp()
        with torch.autocast(device.type, dtype, enabled=dtype is not torch.float32):
            with torch.no_grad():
                # y = r + γ Σ π(a|s') (min Q(s', a) - α log π(a|s')); r alone if s' is terminal
                embedded = target.embed(following)
                log_policy = actor(embedded).float().log_softmax(-1)
                q = two(target.head(embedded)).amin(1)
                value = (log_policy.exp() * (q - alpha * log_policy)).sum(-1)
                y = reward + GAMMA * value.masked_fill(ended, 0.0)
            # The policy reads the critic's encoder but does not train it.
            embedded = critic.embed(maps)
            q = two(critic.head(embedded))
            log_policy = actor(embedded.detach()).float().log_softmax(-1)
        chosen = q.gather(-1, action.unsqueeze(-1).expand(-1, 2, -1)).squeeze(-1)
        policy = log_policy.exp()
        loss = 2 * F.mse_loss(chosen, y.unsqueeze(-1).expand(-1, 2))  # the sum over both Qs
        loss = loss + (policy * (alpha * log_policy - q.detach().amin(1))).sum(-1).mean()
        surplus = (policy * log_policy).sum(-1).mean().detach() + target_entropy
        (loss - log_alpha * surplus).backward()
        optimizer.step()
        optimizer.zero_grad()
        with torch.no_grad():
            torch._foreach_lerp_([*target.parameters()], [*critic.parameters()], TAU)

    return update


def stock_update(steps: TensorDict) -> Callable[[], object]:
    """Returns an update of TorchRL's `DiscreteSACLoss` as in its examples, in float32."""
    side = steps["ego"].shape[-1]
    with torch.device(steps.device):
        actor = TensorDictModule(Network(side), in_keys=[*MAPS], out_keys=["logits"])
        critic = TensorDictModule(Network(side), in_keys=[*MAPS], out_keys=["action_value"])
    policy = ProbabilisticActor(
        actor, in_keys=["logits"], distribution_class=torch.distributions.Categorical
    )
    loss = DiscreteSACLoss(
        policy, critic, action_space="categorical", num_actions=ACTIONS, loss_function="l2",
        alpha_init=0.5, target_entropy_weight=TARGET_ENTROPY_WEIGHT,
    )  # fmt: skip
    loss.make_value_estimator(gamma=GAMMA)
    targets = SoftUpdate(loss, tau=TAU)
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
    """Replaces PyTorch's module tracker, which fails on a LossModule, see docs/upstream.md.

    Only the total is needed, not the operations of each module.
    """

    parents = ("Global",)

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...


def operations(update: Callable[[], object]) -> int:
    """Returns the operations of an update's first call; in later ones, CUDA graphs hide them."""
    counter = FlopCounterMode(display=False)
    counter.mod_tracker = NoModules()
    with counter:
        update()
    return counter.get_total_flops()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=[*SIZES][:-1])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--default-malloc", action="store_true")
    parser.add_argument("--cpu-time", action="store_true")
    args = parser.parse_args()
    clock = time.process_time if args.cpu_time else time.perf_counter
    torch.set_num_threads(1 if args.cpu_time else args.threads)
    kept = not args.default_malloc and keep_freed_memory()
    print(f"{args.device}, {torch.get_num_threads()} threads, freed memory kept: {kept}")
    for size in args.sizes:
        side, batch = SIZES[size]
        torch.manual_seed(0)
        steps = random_steps(side, batch, args.device)
        dtypes = dtypes_of(args.device)
        # On CUDA, updates replay a graph from the fourth on, unless they are eager.
        kinds = {"": False} | ({", eager": True} if args.device.type == "cuda" else {})
        updates = {
            f"flowrep {encoder} {precision}{kind}": flowrep_update(
                steps, encoder, precision, eager=eager
            )
            for precision in dtypes
            for encoder in ("shared", "separate")
            for kind, eager in kinds.items()
        }
        counts = {name: operations(update) for name, update in updates.items()}
        plain = {f"plain shared {name}": plain_update(steps, t) for name, t in dtypes.items()}
        updates |= plain | {STOCK: stock_update(steps)}
        width = 8192 if args.device.type == "cuda" else 2048
        products = {n: matrix_product(t, args.device, width) for n, t in dtypes.items()}
        seconds = interleaved({**updates, **products}, args.rounds, args.device, clock)
        rates = {name: 2 * width**3 / seconds[name] for name in products}
        print(f"\n{size}: {side}x{side}, {len(MAPS)} maps of {CHANNELS} channels, batch {batch}")
        print(", ".join(f"{n} products {r / 1e9:.0f} GFLOP/s" for n, r in rates.items()))
        print("| update | ms | x floor | faster than stock |")
        print("| --- | --- | --- | --- |")
        for name in updates:
            floor = counts[name] / max(rates.values()) if name in counts else None
            of_floor = f"{seconds[name] / floor:.2f}" if floor else ""
            faster = seconds[STOCK] / seconds[name]
            print(f"| {name} | {1e3 * seconds[name]:.1f} | {of_floor} | {faster:.1f} |")


if __name__ == "__main__":
    main()
