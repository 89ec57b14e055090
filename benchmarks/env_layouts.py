"""Frames per second of several ways to step many envs, against drawing in one simulator alone.

    python benchmarks/env_layouts.py [--num-envs 1 2 4 8] [--size 84] [--rounds 3]

Each line adds a layer to the one above: a step to the picture, a vector env, TorchRL's wrapper, the
transforms (ego and obj), worker processes, TorchRL's collector. TorchRL's `ParallelEnv`, with one
env in each process, is measured for comparison. All take turns; medians are shown.
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ParallelEnv

from flowrep.envs import StreetEnv, make_env
from flowrep.scenes import Scene, load_scene

SENSORS = ("depth", "instance", "prev_from_curr", "instance_motion")  # what ego and obj read
MAPS = ("ego", "obj")
MOST_PROCESSES = 8  # of TorchRL, each of which imports torch
Stepper = Callable[[int], Any]  # steps a number of frames


def pictures(scene: Scene) -> tuple[Stepper, Callable[[], None]]:
    env = StreetEnv(scene, sensors=SENSORS)
    env.reset(seed=0)
    env.sensing.rgb(env.episode)  # puts everyone where they are
    return lambda frames: [env.sensing.look(env.episode) for _ in range(frames)], env.close


def gym_env(scene: Scene) -> tuple[Stepper, Callable[[], None]]:
    env, rng = StreetEnv(scene, sensors=SENSORS), np.random.default_rng(0)
    env.reset(seed=0)

    def step(frames: int) -> None:
        for _ in range(frames):
            if env.step(rng.integers(3))[2]:
                env.reset()

    return step, env.close


def gym_vector(scene: Scene, num_envs: int) -> tuple[Stepper, Callable[[], None]]:
    street = partial(StreetEnv, scene, sensors=SENSORS)
    vector = SyncVectorEnv([street] * num_envs, autoreset_mode=AutoresetMode.DISABLED)
    rng = np.random.default_rng(0)
    vector.reset(seed=0)

    def step(frames: int) -> None:
        for _ in range(frames // num_envs):
            _, _, ended, _, _ = vector.step(rng.integers(3, size=num_envs))
            if ended.any():
                vector.reset(options={"reset_mask": ended})

    return step, vector.close


def torchrl_env(env: EnvBase) -> tuple[Stepper, Callable[[], None]]:
    observation = [env.reset()]

    def step(frames: int) -> None:
        for _ in range(frames // env.batch_size.numel()):
            _, observation[0] = env.step_and_maybe_reset(env.rand_action(observation[0]))

    return step, env.close


def collector(env: EnvBase, frames_per_batch: int) -> tuple[Stepper, Callable[[], None]]:
    collect = Collector(env, frames_per_batch=frames_per_batch, total_frames=-1)
    batches = iter(collect)

    def step(frames: int) -> None:
        for _ in range(frames // frames_per_batch):
            next(batches)

    return step, collect.shutdown


def layouts(scene: Scene, n: int) -> dict[str, tuple[Stepper, Callable[[], None]]]:
    make = partial(make_env, scene, representations=MAPS, num_envs=n, seed=0)
    single = partial(make_env, scene, representations=MAPS, seed=0)
    steppers = {
        "the picture alone": pictures(scene),
        "a gymnasium env, one": gym_env(scene),
        "gymnasium's SyncVectorEnv": gym_vector(scene, n),
        "make_env, no representation": torchrl_env(
            make_env(scene, num_envs=n, seed=0, keep_sensor=True)
        ),
        "make_env, ego and obj": torchrl_env(make()),
        "the same, 1 worker": torchrl_env(make(num_workers=1)),
    }
    if n > 1:
        steppers["the same, 2 workers"] = torchrl_env(make(num_workers=2))
        steppers["the same in TorchRL's Collector"] = collector(make(num_workers=2), 16 * n)
    if 1 < n <= MOST_PROCESSES:
        steppers["TorchRL's ParallelEnv, a process each"] = torchrl_env(ParallelEnv(n, single))
    return steppers


def rates(scene: Scene, num_envs: int, frames: int, rounds: int) -> dict[str, float]:
    steppers = layouts(scene, num_envs)
    seconds: dict[str, list[float]] = {name: [] for name in steppers}
    for turn in range(rounds + 1):
        for name, (step, _) in steppers.items():
            start = time.perf_counter()
            step(frames)
            if turn:  # the first one warms up
                seconds[name].append(time.perf_counter() - start)
    for _, close in steppers.values():
        close()
    return {name: frames / statistics.median(each) for name, each in seconds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="straight_road")
    parser.add_argument("--size", type=int, default=84, help="height and width in pixels")
    parser.add_argument("--num-envs", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--frames", type=int, default=512, help="of each layout in each round")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    scene = load_scene(args.scene)
    camera = dataclasses.replace(scene.camera, height_px=args.size, width_px=args.size)
    scene = dataclasses.replace(scene, camera=camera)
    columns = [rates(scene, n, args.frames, args.rounds) for n in args.num_envs]
    names = {name: None for column in columns for name in column}
    print(f"{scene.name}, {args.size}x{args.size}, {torch.get_num_threads()} threads, frames/s")
    print("| num_envs | " + " | ".join(str(n) for n in args.num_envs) + " |")
    print("| --- |" + " --- |" * len(columns))
    for name in names:
        cells = (f"{column[name]:.0f}" if name in column else "" for column in columns)
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
