"""Episodes a second of an evaluation on one core, and a breakdown of a step.

    python benchmarks/evaluation.py [--scene straight_road] [--maps ego obj] [--num-envs 32 96]

The agent has a network's cost but always drives straight on, so that the episodes are the same
whatever is measured. The pools take turns. Times are CPU times.
"""

import argparse
import dataclasses
import statistics
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import torch
from torch import nn

from flowrep.agent.networks import DiscreteActions, acting_network, stochastic_policy
from flowrep.envs import make_env
from flowrep.experiment.arena import Agent, Arena, Job
from flowrep.experiment.env_pool import EnvPool
from flowrep.experiment.eye import Eye
from flowrep.scenes import load_scene
from flowrep.scenes.scene import Scene

FIRST_SEED = 1_000_000


def straight_on(scene: Scene, maps: list[str]) -> Agent:
    """Returns an agent whose network gives all actions the same value; greedy, it never turns."""
    env = make_env(scene, maps, num_envs=1, seed=0)
    specs = env.observation_spec[0], env.action_spec[0]
    env.close()
    device = torch.device("cpu")
    network = acting_network(*specs, maps, device=device, precision="auto", hidden_size=512)
    for parameter in network.network.head.output.parameters():
        nn.init.zeros_(parameter)
    policy = stochastic_policy(network, maps, DiscreteActions.from_spec(specs[1]))
    return Agent(Timed(policy), {name: {} for name in maps})


class Timed:
    """A policy whose calls go through a method that can be timed."""

    def __init__(self, policy: nn.Module) -> None:
        self.policy = policy

    def __call__(self, maps: Any) -> Any:
        return self.policy(maps)


def measured(scene: Scene, agent: Agent, num_envs: int, episodes: int) -> dict[str, float]:
    """Returns CPU seconds by part of an evaluation, its steps and the seconds to make its pool."""
    spent: Counter[str] = Counter()

    def timed(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*args: Any) -> Any:
            started = time.process_time()
            try:
                return call(*args)
            finally:
                spent[name] += time.process_time() - started

        return wrapped

    started = time.process_time()
    arena = Arena(scene, [agent], lambda *world: EnvPool(*world, num_envs=num_envs))
    made = time.process_time()
    jobs = [Job(0, True, "normal", 12.0, FIRST_SEED + k) for k in range(episodes)]
    with ExitStack() as stack:
        parts = {"streets": (EnvPool, "advance"), "see": (Eye, "look"), "act": (Timed, "__call__")}
        for name, (owner, method) in parts.items():
            call = timed(name, getattr(owner, method))
            stack.enter_context(patch.object(owner, method, call))
        steps = sum(episode.length for _, episode in arena.run(jobs))
    ended = time.process_time()
    arena.close()
    return {**spent, "pool": made - started, "run": ended - made, "steps": steps}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="straight_road")
    parser.add_argument("--maps", nargs="+", default=["ego", "obj"])
    parser.add_argument("--size", type=int, default=48, help="height and width in pixels")
    parser.add_argument("--num-envs", type=int, nargs="+", default=[32, 96, 192])
    parser.add_argument("--episodes", type=int, default=96)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    scene = load_scene(args.scene)
    camera = dataclasses.replace(scene.camera, height_px=args.size, width_px=args.size)
    scene = dataclasses.replace(scene, camera=camera)
    agent = straight_on(scene, args.maps)
    measured(scene, agent, 2, 2)  # warms up
    rounds = [
        [measured(scene, agent, num_envs, args.episodes) for num_envs in args.num_envs]
        for _ in range(args.rounds)
    ]
    print(f"{args.episodes} episodes in {args.scene}, {args.size} px, {'+'.join(args.maps)}")
    print("| num_envs | episodes/s | ms a step | streets | see | act | the rest | the pool, s |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for num_envs, runs in zip(args.num_envs, zip(*rounds)):
        best = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
        parts = [1e3 * best[key] / best["steps"] for key in ("run", "streets", "see", "act")]
        rest = parts[0] - sum(parts[1:])
        rate = args.episodes / (best["run"] + best["pool"])
        cells = " | ".join(f"{part:.3f}" for part in (*parts, rest))
        print(f"| {num_envs} | {rate:.1f} | {cells} | {best['pool']:.2f} |")


if __name__ == "__main__":
    main()
