"""A breakdown of the time of one frame, from the simulation to the replay memory.

    python benchmarks/profile_step.py [--scene straight_road] [--size 84] [--num-envs 32]

Functions along the way are timed, each excluding the others that it calls. The training loop is run
without updates. Times are CPU times.
"""

import argparse
import dataclasses
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torchrl.envs import Compose, GymWrapper, InitTracker, TransformedEnv
from update import agent_for

from flowrep.agent import ReplayMemory, keep_freed_memory
from flowrep.envs import StreetEnv, make_env
from flowrep.envs.episode import Episode
from flowrep.envs.vector_env import StreetVectorEnv
from flowrep.scenes import load_scene

WARM_UP = 20  # steps of every env
PARTS: list[tuple[str, Any, str]] = [
    ("maps and motions of all streets", StreetVectorEnv, "_observe"),
    ("driving, people's clock, collisions", Episode, "step"),
    ("new episodes", StreetEnv, "begin"),
    ("the vector of streets", StreetVectorEnv, "step"),
    ("the vector of streets", StreetVectorEnv, "reset"),
    ("TorchRL: GymWrapper", GymWrapper, "_step"),
    ("TorchRL: GymWrapper", GymWrapper, "_reset"),
    ("representations", Compose, "_step"),
    ("representations", Compose, "_reset"),
    ("TorchRL: TransformedEnv, resets, next step", TransformedEnv, "step_and_maybe_reset"),
    ("replay memory", ReplayMemory, "extend"),
]


class SelfTimer:
    """Adds up the time of sections, each without the sections inside it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._open: list[str] = []
        self._since = 0.0

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        self._turn()
        self._open.append(name)
        try:
            yield
        finally:
            self._turn()
            self._open.pop()

    def _turn(self) -> None:
        now = time.process_time()
        if self._open:
            self.seconds[self._open[-1]] += now - self._since
        self._since = now

    def timed(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            with self(name):
                return call(*args, **kwargs)

        return wrapped


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="straight_road")
    parser.add_argument("--size", type=int, default=84, help="height and width in pixels")
    parser.add_argument("--num-envs", type=int, default=32)
    parser.add_argument("--frames", type=int, default=6400)
    args = parser.parse_args()
    keep_freed_memory()
    torch.manual_seed(0)
    scene = load_scene(args.scene)
    camera = dataclasses.replace(scene.camera, height_px=args.size, width_px=args.size)
    scene = dataclasses.replace(scene, camera=camera)
    names = ["ego", "obj"]
    env = make_env(scene, names, num_envs=args.num_envs, seed=0).append_transform(InitTracker())
    # a small memory fills soon, so that all its pages have been touched
    capacity = WARM_UP * args.num_envs
    agent = agent_for(env.observation_spec, env.action_spec, names, replay_capacity=capacity)
    timer = SelfTimer()
    steps = args.frames // args.num_envs
    with ExitStack() as stack, torch.no_grad():
        for name, owner, method in PARTS:
            call = timer.timed(name, getattr(owner, method))
            stack.enter_context(patch.object(owner, method, call))
        observation = env.reset()
        for turn in range(steps + WARM_UP):
            if turn == WARM_UP:
                timer.seconds.clear()
                start = time.process_time()
            with timer("policy"):
                acted = agent.policy(observation)
            stepped, observation = env.step_and_maybe_reset(acted)
            agent.remember(stepped)
    frame = (time.process_time() - start) / (steps * args.num_envs)
    env.close()
    print(f"{scene.name}, {args.size}x{args.size}, {args.num_envs} streets in one process, ego+obj")
    print("| where | ms a frame | share |")
    print("| --- | --- | --- |")
    each = {name: seconds / (steps * args.num_envs) for name, seconds in timer.seconds.items()}
    each["the rest of the loop"] = frame - sum(each.values())
    for name, seconds in sorted(each.items(), key=lambda item: -item[1]):
        print(f"| {name} | {1e3 * seconds:.3f} | {seconds / frame:.1%} |")
    print(f"| **a frame** | {1e3 * frame:.3f} | {1 / frame:.0f} frames/s |")


if __name__ == "__main__":
    main()
