"""Frames a second of 32 envs in one process with ego and obj, and a breakdown of their time.

    python benchmarks/frames.py [--scenes straight_road ...] [--sizes 84 48] [--num-envs 32]

Two ways take turns: the rasteriser drawing all envs at once, and PyBullet drawing each on its own.
Policy and replay memory are left out; actions are random. Times are CPU times, so that other work
on the machine does not count.
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable
from functools import partial
from unittest.mock import patch

import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torchrl.envs import Compose, EnvBase, GymWrapper, TransformedEnv

from flowrep.envs import make_env
from flowrep.envs.episode import Episode
from flowrep.envs.vector_env import StreetVectorEnv
from flowrep.scenes import load_scene, scene_names
from flowrep.scenes.scene import Scene

MAPS = ("ego", "obj")
ONE_BY_ONE = partial(SyncVectorEnv, autoreset_mode=AutoresetMode.DISABLED)


def together(scene: Scene, num_envs: int) -> EnvBase:
    return make_env(scene, MAPS, num_envs=num_envs, seed=0)


def one_by_one(scene: Scene, num_envs: int) -> EnvBase:
    with patch("flowrep.envs.torchrl_env.StreetVectorEnv", ONE_BY_ONE):
        return make_env(scene, MAPS, num_envs=num_envs, seed=0, renderer="pybullet")


def stepper(env: EnvBase) -> Callable[[int], float]:
    """Returns a function that takes a number of steps in every env and returns ms a frame."""
    observation = [env.reset()]

    def take(steps: int) -> float:
        started = time.process_time()
        for _ in range(steps):
            _, observation[0] = env.step_and_maybe_reset(env.rand_action(observation[0]))
        return 1e3 * (time.process_time() - started) / (steps * env.batch_size.numel())

    return take


def row(name: str, size: int, num_envs: int, steps: int, rounds: int) -> str:
    scene = load_scene(name)
    camera = dataclasses.replace(scene.camera, height_px=size, width_px=size)
    scene = dataclasses.replace(scene, camera=camera)
    envs = [make(scene, num_envs) for make in (together, one_by_one)]
    takers = [stepper(env) for env in envs]
    times = [[take(steps) for take in takers] for _ in range(rounds + 1)][1:]  # one to warm up
    parts = shares(envs[0], takers[0], steps)
    for env in envs:
        env.close()
    ours, theirs = (statistics.median(each) for each in zip(*times))
    ratio = statistics.median(b / a for a, b in times)
    cells = f"{theirs:.2f} | {ours:.3f} | {ratio:.1f} | {1e3 / ours:.0f}"
    return f"| {name} | {size} | {cells} | " + " | ".join(f"{part:.3f}" for part in parts) + " |"


def shares(env: EnvBase, take: Callable[[int], float], steps: int) -> list[float]:
    """Returns milliseconds a frame for driving, sensing, representations and TorchRL."""
    owners = [
        (Episode, "step"), (StreetVectorEnv, "_observe"), (Compose, "_step"), (GymWrapper, "_step"),
        (TransformedEnv, "_step"),
    ]  # fmt: skip
    spent = dict.fromkeys(owners, 0.0)

    def timed(key: tuple, method: Callable) -> Callable:
        def wrapped(*args, **kwargs):
            started = time.process_time()
            try:
                return method(*args, **kwargs)
            finally:
                spent[key] += 1e3 * (time.process_time() - started)

        return wrapped

    patches = [patch.object(*key, timed(key, getattr(*key))) for key in owners]
    for each in patches:
        each.start()
    whole = take(steps)
    for each in patches:
        each.stop()
    frames = steps * env.batch_size.numel()
    drive, see, represent, *_ = (spent[key] / frames for key in owners)
    return [drive, see, represent, whole - drive - see - represent]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=scene_names())
    parser.add_argument("--sizes", type=int, nargs="+", default=[84, 48])
    parser.add_argument("--num-envs", type=int, default=32)
    parser.add_argument("--steps", type=int, default=10, help="of every street in each round")
    parser.add_argument("--rounds", type=int, default=9)
    args = parser.parse_args()
    torch.manual_seed(0)
    print(f"{args.num_envs} streets in one process, {torch.get_num_threads()} threads, ms a frame")
    print(
        "| scene | pixels | PyBullet | flowrep | ratio | frames/s "
        "| drive | see | represent | the rest |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in args.scenes:
        for size in args.sizes:
            print(row(name, size, args.num_envs, args.steps, args.rounds), flush=True)


if __name__ == "__main__":
    main()
