"""Time of an env step beside PyBullet's picture of the same view.

python benchmarks/env_step.py --scenes s_turn three_way_junction --size 84

The two take turns, so that both run under the same load, and each view is drawn by both. A planner
drives, so that whole episodes are covered; its own time is not counted.
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

from flowrep.baselines import Planner
from flowrep.envs import StreetEnv
from flowrep.scenes import load_scene, scene_names

SENSORS = ("depth", "semantic", "instance", "prev_from_curr", "instance_motion")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=scene_names())
    parser.add_argument("--size", type=int, default=84, help="height and width in pixels")
    parser.add_argument("--steps", type=int, default=600)
    args = parser.parse_args()
    print(f"{args.size}x{args.size}, {args.steps} steps a scene, one process, milliseconds")
    print("| scene | people | build | step | picture | picture / step | frames/s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in args.scenes:
        print(row(name, args.size, args.steps), flush=True)


def row(name: str, size: int, count: int) -> str:
    scene = load_scene(name)
    camera = dataclasses.replace(scene.camera, height_px=size, width_px=size)
    scene = dataclasses.replace(scene, camera=camera)
    build, env = timed(lambda: StreetEnv(scene, sensors=SENSORS))
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
    times = " | ".join(f"{1e3 * seconds:.2f}" for seconds in (build, step, picture))
    return f"| {scene.name} | {scene.num_pedestrians} | {times} | {paired:.1f} | {1 / step:.0f} |"


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    started = time.process_time()
    result = call()
    return time.process_time() - started, result


if __name__ == "__main__":
    main()
