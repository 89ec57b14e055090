"""The rasteriser's maps beside those of PyBullet's picture: differences and times.

    python benchmarks/rasterise.py [--views 1000] [--sizes 48 84 168] [--scenes s_turn ...]

Half of the views are from anywhere on the road, half from a few steps in front of a person. The two
take turns. Times are medians of CPU times, so that other work on the machine does not count.
"""

import argparse
import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import shapely

from flowrep.envs import StreetEnv
from flowrep.envs.episode import Moment
from flowrep.scenes import load_scene, scene_names
from flowrep.scenes.vehicle import VehicleState

MAPS = ("depth", "semantic", "instance")
VIEWS_AN_EPISODE = 10
LATEST_TICK = 400
TOUCHING = 1e-5  # relative difference in depth of surfaces that lie in one plane


class Difference(NamedTuple):
    """Differences between two renderers in one view, in pixels."""

    ids: int  # pixels of another class or instance
    inside: int  # of those, away from every border and not where two surfaces coincide
    depth: float  # median relative error where both see the same body
    seen: set[int]  # classes


class Pair:
    """One street twice, drawn by PyBullet and by the rasteriser."""

    def __init__(self, scene: Any) -> None:
        self.scene = load_scene(scene)
        self.pictured, self.drawn = (
            StreetEnv(self.scene, sensors=MAPS, renderer=name)
            for name in ("pybullet", "rasteriser")
        )

    def views(self, count: int, seed: int = 0) -> Iterator[None]:
        """Sets both streets to the same view, `count` times."""
        rng = np.random.default_rng(seed)
        for number in range(count):
            if number % VIEWS_AN_EPISODE == 0:
                episode_seed, ticks = int(rng.integers(1 << 31)), int(rng.integers(LATEST_TICK))
                for env in (self.pictured, self.drawn):
                    env.reset(options={"episode_seed": episode_seed})
            there = viewpoint(self.drawn, rng, before_a_person=number % 2 == 1)
            for env in (self.pictured, self.drawn):
                env.episode.resume(Moment(there, ticks), Moment(there, ticks))
            yield

    def difference(self) -> Difference:
        """Compares the two renderers in the current view."""
        pictured, drawn = (env.sensing.observe(env.episode) for env in (self.pictured, self.drawn))
        bodies = [256 * o["semantic"][0].astype(int) + o["instance"][0] for o in (pictured, drawn)]
        differ = bodies[0] != bodies[1]
        both = np.isfinite(pictured["depth"][0]) & np.isfinite(drawn["depth"][0])
        error = np.ones(both.shape)
        np.divide(drawn["depth"][0], pictured["depth"][0], where=both, out=error)
        error[both] = np.abs(error[both] - 1.0)
        coincide = error < TOUCHING
        return Difference(
            int(differ.sum()),
            int((differ & ~borders(bodies[0]) & ~coincide).sum()),
            float(np.median(error[both & ~differ])) if (both & ~differ).any() else 0.0,
            set(np.unique(drawn["semantic"]).tolist()),
        )

    def close(self) -> None:
        self.pictured.close()
        self.drawn.close()


def viewpoint(env: StreetEnv, rng: np.random.Generator, *, before_a_person: bool) -> VehicleState:
    episode = env.episode
    if before_a_person and len(episode.poses):
        x, y = episode.poses[rng.integers(len(episode.poses)), :2]
        distance, bearing = rng.uniform(0.2, 8.0), rng.uniform(-math.pi, math.pi)
        x, y = x - distance * math.cos(bearing), y - distance * math.sin(bearing)
        return VehicleState(x, y, bearing + rng.uniform(-0.7, 0.7), 0.0)
    road = episode.layout.drivable
    x0, y0, x1, y1 = road.bounds
    while True:
        x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
        if shapely.contains_xy(road, x, y):
            return VehicleState(x, y, rng.uniform(-math.pi, math.pi), 0.0)


def borders(bodies: np.ndarray) -> np.ndarray:
    """Returns a mask of pixels with another body in their 3 × 3 neighbourhood, and of the rim."""
    marked = np.ones(bodies.shape, dtype=bool)
    windows = np.lib.stride_tricks.sliding_window_view(bodies, (3, 3))
    marked[1:-1, 1:-1] = (windows != bodies[1:-1, 1:-1, None, None]).any(axis=(-2, -1))
    return marked


def cpu_ms(call: Callable[[], Any]) -> float:
    started = time.process_time()
    call()
    return 1e3 * (time.process_time() - started)


def agreement_row(name: str, count: int) -> str:
    pair = Pair(name)
    found = [pair.difference() for _ in pair.views(count)]
    pixels = count * pair.scene.camera.height_px * pair.scene.camera.width_px
    pair.close()
    ids, inside, depth = (list(column) for column in list(zip(*found))[:3])
    cells = f"{100 * (1 - sum(ids) / pixels):.5f} % | {max(ids)} | {sum(inside)}"
    return f"| {pair.scene.name} | {cells} | {np.median(depth):.1e} | {max(depth):.1e} |"


def cost_row(name: str, size: int, count: int) -> str:
    scene = load_scene(name)
    camera = dataclasses.replace(scene.camera, height_px=size, width_px=size)
    pair = Pair(dataclasses.replace(scene, camera=camera))
    pictures, drawings, colours, maps = [], [], [], []
    env, sensing = pair.pictured, pair.drawn.sensing
    rasterise = sensing._rasteriser(1)
    for _ in pair.views(count, seed=1):
        env.sensing.observe(env.episode)  # puts everyone where they are
        pictures.append(cpu_ms(lambda: env.sensing.look(env.episode)))
        views = sensing.views([pair.drawn.episode])
        drawings.append(cpu_ms(lambda: rasterise(*views)))  # noqa: B023
        colours.append(cpu_ms(lambda: rasterise(*views, rgb=True)))  # noqa: B023
        maps.append(cpu_ms(lambda: sensing.observe(pair.drawn.episode)))
    triangles = sum(len(body.triangles) for body in pair.drawn._street.bodies)
    pair.close()
    picture, whole = statistics.median(pictures), statistics.median(maps)
    times = f"{picture:.2f} | {whole:.3f}"
    for each in (drawings, colours):
        ratio = statistics.median(p / d for p, d in zip(pictures, each))
        times += f" | {statistics.median(each):.3f} | {ratio:.1f}"
    return f"| {scene.name} | {size} | {triangles} | {times} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=scene_names())
    parser.add_argument("--views", type=int, default=1000, help="of each scene, for agreement")
    parser.add_argument("--sizes", type=int, nargs="*", default=[48, 84, 168])
    parser.add_argument("--timed-views", type=int, default=200, help="of each scene and size")
    args = parser.parse_args()
    if args.views:
        print("| scene | ids equal | most differ in a view | inside | depth: median | worst view |")
        print("| --- | --- | --- | --- | --- | --- |")
        for name in args.scenes:
            print(agreement_row(name, args.views), flush=True)
    if args.sizes:
        print(
            "\n| scene | pixels | triangles | getCameraImage, ms | observing maps, ms "
            "| drawing maps, ms | ratio | with colours, ms | ratio |"
        )
        print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
        for name in args.scenes:
            for size in args.sizes:
                print(cost_row(name, size, args.timed_views), flush=True)


if __name__ == "__main__":
    main()
