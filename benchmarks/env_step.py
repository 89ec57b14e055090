"""What a step of the street costs beside its picture: bound 1.3 × a bare getCameraImage.

The two take turns, so that both see the same machine, and each view is drawn by both.
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

from flowrep.envs import StreetEnv, load_scene

BOUND = 1.3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="straight_road")
    parser.add_argument("--size", type=int, default=84, help="height and width in pixels")
    parser.add_argument("--steps", type=int, default=1000)
    args = parser.parse_args()
    scene = load_scene(args.scene)
    camera = dataclasses.replace(scene.camera, height_px=args.size, width_px=args.size)
    env = StreetEnv(
        dataclasses.replace(scene, camera=camera),
        sensors=("depth", "semantic", "instance", "prev_from_curr", "instance_motion"),
    )
    steps, pictures = [], []
    env.reset(seed=0)
    for _ in range(args.steps):
        seconds, (*_, terminated, _, _) = timed(lambda: env.step(0))
        steps.append(seconds)
        pictures.append(timed(lambda: env.sensing.look(env.episode))[0])
        if terminated:
            env.reset()
    step, picture = statistics.median(steps), statistics.median(pictures)
    paired = statistics.median(s / p for s, p in zip(steps, pictures))
    print(f"{args.scene} {args.size}x{args.size}, {scene.num_pedestrians} people, one process")
    print(f"env.step            {1e3 * step:.3f} ms  ({1 / step:.0f} frames/s)")
    print(f"bare getCameraImage {1e3 * picture:.3f} ms  ({1 / picture:.0f} frames/s)")
    verdict = "ok" if step / picture <= BOUND else "TOO SLOW"
    print(f"ratio of medians {step / picture:.3f}, paired {paired:.3f}; bound {BOUND}: {verdict}")


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    started = time.perf_counter()
    result = call()
    return time.perf_counter() - started, result


if __name__ == "__main__":
    main()
