"""What a frame costs: PyBullet's picture beside the rasteriser's maps, and steps of whole envs.

    python benchmarks/frames.py [--scenes straight_road ...] [--sizes 84 48] [--num-envs 32]

1. One view: a planner drives, and every view is drawn by both renderers, with all people in place.
2. A frame of 32 envs in one process with ego and obj and random actions, without policy and replay
   memory.
3. A frame of one gymnasium env: its sensors alone, and with ego and obj, in turns.
4. Frames per second by number of worker processes, with `--workers 0 1 4`; 0 is this process alone.

The first three are CPU times, so that other work on the machine does not count; the fourth is wall
time. With `--device cuda` only the fourth runs.
"""

import argparse
import dataclasses
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import torch
from torchrl.envs import Compose, EnvBase, TransformedEnv

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.pybullet_view import PyBulletView
from flowrep.baselines import Planner
from flowrep.envs import StreetEnv, make_env
from flowrep.envs.gym_wrappers import make_street
from flowrep.envs.street_env import Episode
from flowrep.envs.vector_env import StreetVectorEnv
from flowrep.scenes import load_scene, scene_names
from flowrep.scenes.scene import Scene
from flowrep.simulator.street import Street

REPRESENTATIONS = ("ego", "obj")
MAPS = ("depth", "semantic", "instance")
SENSORS = (*MAPS, "prev_from_curr", "instance_motion")


def in_size(name: str, size: int) -> Scene:
    """Returns a scene whose camera's picture is `size` pixels high and wide."""
    scene = load_scene(name)
    camera = dataclasses.replace(scene.camera, height_px=size, width_px=size)
    return dataclasses.replace(scene, camera=camera)


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Returns the CPU time of a call in ms, and its result."""
    started = time.process_time()
    result = call()
    return 1e3 * (time.process_time() - started), result


def view_times(scene: Scene, count: int) -> Iterator[dict[str, float]]:
    """Yields the ms of a step and of drawing its view, `count` times."""
    env, planner = StreetEnv(scene, sensors=SENSORS), Planner()
    pictured = PyBulletView(Street.shared(scene), scene.camera)
    rasterise = env.sensing._rasteriser(1)
    env.reset(seed=0)
    for _ in range(count):
        action = planner(env)  # not counted
        step, (*_, terminated, _, _) = timed(lambda action=action: env.step(action))
        poses = cam_from_world, parts, is_shown = env.sensing.views([env.episode])
        pictured.place(parts[0], is_shown[0])  # not counted
        yield {
            "step": step,
            "picture": timed(lambda: pictured.look(cam_from_world[0]))[0],  # noqa: B023
            "maps": timed(lambda: rasterise(*poses))[0],  # noqa: B023
            "colours": timed(lambda: rasterise(*poses, rgb=True))[0],  # noqa: B023
        }
        if terminated:
            env.reset()
    env.close()
    pictured.close()


def view_row(name: str, size: int, count: int) -> str:
    scene = in_size(name, size)
    times = list(view_times(scene, count))
    median = {key: statistics.median(each[key] for each in times) for key in times[0]}
    triangles = sum(len(body.corners) for body in Street.shared(scene).bodies)
    cells = f"{scene.num_pedestrians} | {triangles} | {median['picture']:.2f}"
    for key in ("maps", "colours"):
        ratio = statistics.median(each["picture"] / each[key] for each in times)
        cells += f" | {median[key]:.3f} | {ratio:.1f}"
    return f"| {name} | {size} | {cells} | {median['step']:.2f} |"


def stepper(env: EnvBase, clock: Callable[[], float] = time.process_time) -> Callable[[int], float]:
    """Returns a function that takes a number of steps in every env and returns ms per frame."""
    observation = [env.reset()]

    def take(steps: int) -> float:
        started = clock()
        for _ in range(steps):
            _, observation[0] = env.step_and_maybe_reset(env.rand_action(observation[0]))
        if env.device is not None and env.device.type == "cuda":
            torch.cuda.synchronize()
        return 1e3 * (clock() - started) / (steps * env.batch_size.numel())

    return take


def frame_row(name: str, size: int, num_envs: int, steps: int, rounds: int) -> str:
    env = make_env(in_size(name, size), REPRESENTATIONS, num_envs=num_envs, seed=0)
    take = stepper(env)
    ms = statistics.median([take(steps) for _ in range(rounds + 1)][1:])  # one to warm up
    parts = shares(env, take, steps)
    env.close()
    cells = f"{ms:.3f} | {1e3 / ms:.0f}"
    return f"| {name} | {size} | {cells} | " + " | ".join(f"{part:.3f}" for part in parts) + " |"


def shares(env: EnvBase, take: Callable[[int], float], steps: int) -> list[float]:
    """Returns ms per frame for driving, sensing, representations and the rest, mostly TorchRL."""
    owners = [
        (Episode, "step"), (StreetVectorEnv, "_observe"), (Compose, "_step"),
        (TransformedEnv, "_step"),
    ]  # fmt: skip
    spent = dict.fromkeys(owners, 0.0)

    def watched(key: tuple, method: Callable) -> Callable:
        def wrapped(*args, **kwargs):
            ms, result = timed(lambda: method(*args, **kwargs))
            spent[key] += ms
            return result

        return wrapped

    patches = [patch.object(*key, watched(key, getattr(*key))) for key in owners]
    for each in patches:
        each.start()
    whole = take(steps)
    for each in patches:
        each.stop()
    frames = steps * env.batch_size.numel()
    drive, sense, represent, _ = (spent[key] / frames for key in owners)
    return [drive, sense, represent, whole - drive - sense - represent]


def gym_row(name: str, size: int, rounds: int) -> str:
    envs = [make_street(in_size(name, size), maps) for maps in ((), REPRESENTATIONS)]
    for env in envs:
        env.reset(seed=0)

    def steps(env: gym.Env) -> None:
        for _ in range(30):
            _, _, terminated, _, _ = env.step(0)
            if terminated:
                env.reset()

    turns = [[timed(lambda: steps(env))[0] / 30 for env in envs] for _ in range(10 * rounds)]  # noqa: B023
    sensors, flow = (statistics.median(each) for each in zip(*turns))
    ratio = statistics.median(both / alone for alone, both in turns)
    return f"| {name} | {size} | {1e3 / sensors:.0f} | {1e3 / flow:.0f} | {ratio:.2f} |"


def worker_row(
    name: str, size: int, num_envs: int, workers: int, steps: int, device: torch.device
) -> str:
    env = make_env(
        in_size(name, size), REPRESENTATIONS, num_envs=num_envs, num_workers=workers,
        device=device, seed=0,
    )  # fmt: skip
    take = stepper(env, time.perf_counter)
    take(steps)  # warms up
    rate = 1e3 / take(6 * steps)
    env.close()
    return f"| {name} | {size} | {workers} | {rate:.0f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=scene_names())
    parser.add_argument("--sizes", type=int, nargs="+", default=[84, 48])
    parser.add_argument("--num-envs", type=int, default=32)
    parser.add_argument("--views", type=int, default=300, help="views of each scene and size")
    parser.add_argument("--steps", type=int, default=10, help="steps of every env in each round")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--workers", type=int, nargs="*", default=[])
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    rows = [(name, size) for name in args.scenes for size in args.sizes]
    if args.device.type == "cpu":
        print(
            "| scene | pixels | people | triangles | getCameraImage, ms | maps, ms | ratio "
            "| with colours, ms | ratio | env's step, ms |"
        )
        print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
        for row in rows:
            print(view_row(*row, args.views), flush=True)
        print(f"\n{args.num_envs} envs in one process, one thread, ms per frame")
        print("| scene | pixels | ms | frames/s | drive | sense | represent | rest |")
        print("| --- | --- | --- | --- | --- | --- | --- | --- |")
        for row in rows:
            print(frame_row(*row, args.num_envs, args.steps, args.rounds), flush=True)
        print("\none gymnasium env, one thread, frames/s of CPU time, and the ratio of their times")
        print("| scene | pixels | sensors alone | with ego and obj | ratio |")
        print("| --- | --- | --- | --- | --- |")
        for row in rows:
            print(gym_row(*row, args.rounds), flush=True)
    if args.workers:
        print(f"\n{args.num_envs} envs, {args.device}\n| scene | pixels | workers | frames/s |")
        print("| --- | --- | --- | --- |")
        for row in rows:
            for workers in args.workers:
                print(worker_row(*row, args.num_envs, workers, args.steps, args.device), flush=True)


if __name__ == "__main__":
    main()
