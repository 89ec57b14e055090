"""Episodes per second of an evaluation on one core, and how long each part of a step takes.

    python benchmarks/evaluation.py [--scene straight_road] [--maps ego obj] [--num-envs 32 96]

The agent costs as much as a trained network but always drives straight on, so that all measurements
are of the same episodes. The batch sizes take turns. Times are CPU times.
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
from torchrl.envs import GymWrapper, TransformedEnv

from flowrep.agent.networks import DiscreteActions, acting_network, stochastic_policy
from flowrep.envs import make_env
from flowrep.experiment.evaluation import Policy, evaluate
from flowrep.scenes import Scene, load_scene

FIRST_SEED = 1_000_000


class StraightOn:
    """A policy whose network gives all actions the same value; greedy, it never turns."""

    def __init__(self, scene: Scene, maps: list[str]) -> None:
        env = make_env(scene, maps, num_envs=1, seed=0)
        specs = env.observation_spec[0], env.action_spec[0]
        env.close()
        device = torch.device("cpu")
        network = acting_network(*specs, maps, device=device, precision="auto", hidden_size=512)
        for parameter in network.network.head.output.parameters():
            nn.init.zeros_(parameter)
        self.policy = stochastic_policy(network, maps, DiscreteActions.from_spec(specs[1]))

    def __call__(self, maps: Any) -> Any:
        return self.policy(maps)


def measured(
    scene: Scene, maps: list[str], policy: Policy, num_envs: int, episodes: int
) -> dict[str, float]:
    """Returns CPU seconds by part, for making the env and for all, and the number of steps."""
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
    env = make_env(scene, maps, num_envs=num_envs)
    made = time.process_time()
    options = [{"episode_seed": FIRST_SEED + k, "speed": "normal"} for k in range(episodes)]
    # A step of the TransformedEnv contains the GymWrapper's, which drives and draws the streets.
    # The rest of it computes the representations.
    parts = {"streets": (GymWrapper, "_step"), "env": (TransformedEnv, "_step")}
    with ExitStack() as stack:
        for name, (owner, method) in (parts | {"act": (StraightOn, "__call__")}).items():
            call = timed(name, getattr(owner, method))
            stack.enter_context(patch.object(owner, method, call))
        steps = sum(episode.length for episode in evaluate(env, policy, options))
    ended = time.process_time()
    env.close()
    spent["represent"] = spent.pop("env") - spent["streets"]
    return {**spent, "make": made - started, "run": ended - made, "steps": steps}


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
    policy = StraightOn(scene, args.maps)
    measured(scene, args.maps, policy, 2, 2)  # warms up
    rounds = [
        [measured(scene, args.maps, policy, num_envs, args.episodes) for num_envs in args.num_envs]
        for _ in range(args.rounds)
    ]
    print(f"{args.episodes} episodes in {args.scene}, {args.size} px, {'+'.join(args.maps)}")
    print(
        "| num_envs | episodes/s | ms per step | streets | represent | act | rest | make env, s |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for num_envs, runs in zip(args.num_envs, zip(*rounds)):
        median = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
        names = ("run", "streets", "represent", "act")
        parts = [1e3 * median[name] / median["steps"] for name in names]
        rest = parts[0] - sum(parts[1:])
        rate = args.episodes / (median["run"] + median["make"])
        cells = " | ".join(f"{part:.3f}" for part in (*parts, rest))
        print(f"| {num_envs} | {rate:.1f} | {cells} | {median['make']:.2f} |")


if __name__ == "__main__":
    main()
