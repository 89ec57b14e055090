"""Error of estimated flow against exact flow, on flowrep's own scenes.

A planner drives; at every fourth step each estimator sees the last two pictures and is compared
with the simulator's flow. The tables show the end-point error in pixels a step, over all pixels
with known flow and over people alone; "no flow" is the baseline to beat. The second table breaks
the error down. RAFT takes part if weights are given.

python benchmarks/estimated_flow.py --scenes straight_road s_turn --sizes 48 84 --steps 60
"""

import argparse
import time
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from flowrep.baselines.planner import Planner
from flowrep.config_tree import CONF_DIR, group_choices
from flowrep.envs import make_env, street_envs
from flowrep.geometry import rigid_flow
from flowrep.palette import CLASS_COLOURS
from flowrep.transforms import DIS, EstimatedFlow

SEE_EVERY = 4


class Seen(NamedTuple):
    """Pairs of pictures [N, 6, H, W], the exact flow between them and the pixels' classes."""

    pairs: Tensor
    truth: Tensor
    known: Tensor  # [N, H, W]
    person: Tensor
    semantic: Tensor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=["straight_road"])
    parser.add_argument("--sizes", nargs="+", type=int, default=[48, 84])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--num-envs", type=int, default=4)
    parser.add_argument("--raft-weights", help="state dict of torchvision's raft_small")
    args = parser.parse_args()
    for scene in args.scenes:
        for size in args.sizes:
            print(f"\n{scene}, {size} x {size} px: driving {args.steps} steps ...", flush=True)
            seen = drive(scene, size, args.steps, args.num_envs)
            best = compare(seen, contenders(args.raft_weights))
            where_it_lies(seen, best)


def contenders(raft_weights: str | None) -> dict[str, Callable[[Tensor], Tensor]]:
    """Returns functions from pairs of pictures to raw flow, by name."""
    estimators: dict[str, EstimatedFlow] = {
        f"DIS {preset}, {'enlarged' if side > 1 else 'as it is'}": EstimatedFlow(DIS(preset, side))
        for preset in ("ultrafast", "fast", "medium")
        for side in (1, 160)
    }
    if raft_weights is not None:
        estimators["RAFT small"] = EstimatedFlow("raft_small", weights=raft_weights)
    no_flow = {"no flow": lambda pairs: torch.zeros_like(pairs[:, :2], dtype=torch.float32)}
    return no_flow | {
        name: lambda pairs, made=made: made.compute(pairs)[0] for name, made in estimators.items()
    }


def drive(scene: str, size: int, steps: int, num_envs: int) -> Seen:
    env = make_env(sized(scene, size), ["rgb"], num_envs=num_envs, keep_sensor=True, seed=2)
    planners = [(Planner(), street) for street in street_envs(env)]
    K = torch.as_tensor(planners[0][1].K).float()
    parts: list[Seen] = []
    tensordict = env.reset()
    for step in range(1, steps + 1):
        action = torch.tensor([planner(street) for planner, street in planners])
        previous = tensordict["rgb"].clone()
        stepped, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
        if step % SEE_EVERY == 0:
            sensor, rgb = stepped["next", "sensor"], stepped["next", "rgb"]
            ids, motion = sensor["instance"], sensor["instance_motion"]
            truth, known = rigid_flow(sensor["depth"], ids, K, motion)
            maps = (torch.cat([previous, rgb], -3), truth, known[:, 0])
            parts.append(Seen(*maps, (ids > 0)[:, 0], sensor["semantic"][:, 0].clone()))
    env.close()
    return Seen(*(torch.cat(maps) for maps in zip(*parts)))


def sized(scene: str, size: int) -> dict:
    import yaml

    if scene not in group_choices("scene"):
        raise SystemExit(f"unknown scene {scene!r}; there are {group_choices('scene')}")
    text = (CONF_DIR / "scene" / f"{scene}.yaml").read_text(encoding="utf-8")
    made = yaml.safe_load(text)
    made["camera"] |= {"height_px": size, "width_px": size}
    return made


def compare(seen: Seen, contenders: dict[str, Callable[[Tensor], Tensor]]) -> Tensor:
    """Prints the table; returns the error of the last contender, [N, H, W]."""
    people = seen.known & seen.person
    print(f"{len(seen.pairs)} pairs, {int(people.sum())} pixels of people")
    print(f"{'':28}{'all':>14}{'people':>16}")
    print(f"{'end-point error, px':28}" + "  median   mean" * 2 + "   ms a picture")
    for name, estimate in contenders.items():
        started = time.perf_counter()
        flow = estimate(seen.pairs)
        spent_ms = 1e3 * (time.perf_counter() - started) / len(seen.pairs)
        error = (flow - seen.truth).norm(dim=1)
        cells = [f"{pick(error[mask]):8.2f}" for mask in (seen.known, people) for pick in PICKS]
        print(f"{name:28}" + "".join(cells) + f"{spent_ms:12.2f}", flush=True)
    return error


def median(values: Tensor) -> float:
    return float(values.median()) if len(values) else float("nan")


def mean(values: Tensor) -> float:
    return float(values.mean())


PICKS = (median, mean)


def where_it_lies(seen: Seen, error: Tensor) -> None:
    print(f"{'by what is seen (the last)':28}   error  motion   share   (medians, px)")
    motion = seen.truth.norm(dim=1)
    for number, name in enumerate(CLASS_COLOURS):
        mask = seen.known & (seen.semantic == number)
        if mask.any():
            share = float(mask.sum() / seen.known.sum())
            print(f"{name:28}{median(error[mask]):8.2f}{median(motion[mask]):8.2f}{share:8.0%}")


if __name__ == "__main__":
    main()
