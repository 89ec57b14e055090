"""Time of one env's step beside PyBullet's picture, and frames per second of 32 envs together.

    python benchmarks/frames.py [--scenes straight_road ...] [--sizes 84 48] [--num-envs 32]

First a table of single envs: a planner drives, and each view is also drawn by PyBullet. Then 32 in
one process with ego and obj and random actions, without policy and replay memory, in two ways that
take turns: the rasteriser drawing all envs at once, and PyBullet drawing each on its own. Times are
CPU times, so that other work on the machine does not count.
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import torch
from torchrl.envs import Compose, EnvBase, TransformedEnv

from flowrep.baselines import Planner
from flowrep.envs import StreetEnv, make_env
from flowrep.envs.episode import Episode
from flowrep.envs.vector_env import StreetVectorEnv
from flowrep.scenes import load_scene, scene_names
from flowrep.scenes.scene import Scene

MAPS = ("ego", "obj")
SENSORS = ("depth", "semantic", "instance", "prev_from_curr", "instance_motion")


def in_size(name: str, size: int) -> Scene:
    """Returns a scene whose camera has `size` pixels a side."""
    scene = load_scene(name)
    camera = dataclasses.replace(scene.camera, height_px=size, width_px=size)
    return dataclasses.replace(scene, camera=camera)


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    started = time.process_time()
    result = call()
    return time.process_time() - started, result


def single_row(name: str, size: int, count: int) -> str:
    """Times steps of one env; the planner's own time is not counted."""
    scene = in_size(name, size)
    env = StreetEnv(scene, sensors=SENSORS)
    planner, steps, pictures = Planner(), [], []
    env.reset(seed=0)
    while len(steps) < count:
        action = planner(env)
        seconds, (*_, terminated, _, _) = timed(lambda action=action: env.step(action))
        steps.append(seconds)
        env.sensing.rgb(env.episode)  # puts everyone where they are
        pictures.append(timed(lambda: env.sensing.look(env.episode))[0])
        if terminated:
            env.reset()
    env.close()
    step, picture = statistics.median(steps), statistics.median(pictures)
    paired = statistics.median(p / s for s, p in zip(steps, pictures))
    cells = f"{1e3 * step:.2f} | {1e3 * picture:.2f} | {paired:.1f} | {1 / step:.0f}"
    return f"| {name} | {size} | {scene.num_pedestrians} | {cells} |"


def together(scene: Scene, num_envs: int) -> EnvBase:
    return make_env(scene, MAPS, num_envs=num_envs, seed=0)


def one_by_one(scene: Scene, num_envs: int) -> EnvBase:
    return make_env(scene, MAPS, num_envs=num_envs, seed=0, renderer="pybullet")


def stepper(env: EnvBase, clock: Callable[[], float] = time.process_time) -> Callable[[int], float]:
    """Returns a function that takes a number of steps in every env and returns ms per frame."""
    observation = [env.reset()]

    def take(steps: int) -> float:
        started = clock()
        for _ in range(steps):
            _, observation[0] = env.step_and_maybe_reset(env.rand_action(observation[0]))
        return 1e3 * (clock() - started) / (steps * env.batch_size.numel())

    return take


def batch_row(name: str, size: int, num_envs: int, steps: int, rounds: int) -> str:
    scene = in_size(name, size)
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
    """Returns milliseconds per frame for driving, sensing, representations and TorchRL."""
    owners = [
        (Episode, "step"), (StreetVectorEnv, "_observe"), (Compose, "_step"),
        (TransformedEnv, "_step"),
    ]  # fmt: skip
    spent = dict.fromkeys(owners, 0.0)

    def watched(key: tuple, method: Callable) -> Callable:
        def wrapped(*args, **kwargs):
            seconds, result = timed(lambda: method(*args, **kwargs))
            spent[key] += 1e3 * seconds
            return result

        return wrapped

    patches = [patch.object(*key, watched(key, getattr(*key))) for key in owners]
    for each in patches:
        each.start()
    whole = take(steps)
    for each in patches:
        each.stop()
    frames = steps * env.batch_size.numel()
    drive, see, represent, _ = (spent[key] / frames for key in owners)
    return [drive, see, represent, whole - drive - see - represent]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=scene_names())
    parser.add_argument("--sizes", type=int, nargs="+", default=[84, 48])
    parser.add_argument("--num-envs", type=int, default=32)
    parser.add_argument("--steps", type=int, default=10, help="of every env in each round")
    parser.add_argument("--rounds", type=int, default=9)
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    print("| scene | pixels | people | step, ms | picture, ms | picture / step | steps/s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in args.scenes:
        print(single_row(name, args.sizes[0], 60 * args.steps), flush=True)
    print(f"\n{args.num_envs} envs in one process, one thread, ms per frame")
    print(
        "| scene | pixels | PyBullet | flowrep | ratio | frames/s "
        "| drive | see | represent | the rest |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in args.scenes:
        for size in args.sizes:
            print(batch_row(name, size, args.num_envs, args.steps, args.rounds), flush=True)


if __name__ == "__main__":
    main()
