"""The rasteriser and PyBullet see the same street.

Half of the views are from anywhere on the road, half from a few steps in front of a person.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from benchmarks.pybullet_view import PyBulletView
from flowrep.envs import StreetEnv
from flowrep.envs.street_env import Moment
from flowrep.scenes import load_scene, scene_names
from flowrep.scenes.scene import CATEGORY_ID, Scene
from flowrep.scenes.vehicle import VehicleState
from flowrep.simulator.street import Street
from tests.comparing import differing

MAPS = ("depth", "semantic", "instance")
VIEWS_AN_EPISODE = 10
LATEST_TICK = 400
TOUCHING = 1e-5  # relative difference in depth of surfaces that lie in one plane
CROSSROADS = Path(__file__).parents[1] / "scenes" / "crossroads.yaml"


def views(scene: Scene, count: int) -> Iterator[tuple[Any, Any]]:
    """Yields what PyBullet and the rasteriser see of a street from `count` places."""
    rng = np.random.default_rng(0)
    env = StreetEnv(scene, sensors=MAPS)
    pictured = PyBulletView(Street.shared(env.scene), env.scene.camera)
    for number in range(count):
        if number % VIEWS_AN_EPISODE == 0:
            episode_seed, ticks = int(rng.integers(1 << 31)), int(rng.integers(LATEST_TICK))
            env.reset(options={"episode_seed": episode_seed})
        there = viewpoint(env, rng, before_a_person=number % 2 == 1)
        env.episode.resume(Moment(there, ticks), Moment(there, ticks))
        cam_from_world, world_from_part, is_shown = env.sensing.views([env.episode])
        pictured.place(world_from_part[0], is_shown[0])
        yield pictured.maps(cam_from_world[0]), env.sensing.observe(env.episode)
    pictured.close()


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


def assert_agree(scene, count):
    """Compares so many views; returns the classes that were seen."""
    shares, depth_errors, seen = [], [], set()
    for pictured, drawn in views(scene, count):
        one, other = (
            256 * o["semantic"][0].astype(int) + o["instance"][0] for o in (pictured, drawn)
        )
        depth, drawn_depth = pictured["depth"][0].astype(float), drawn["depth"][0]
        both, error = np.isfinite(depth) & np.isfinite(drawn_depth), np.ones(one.shape)
        error[both] = np.abs(drawn_depth[both] / depth[both] - 1.0)
        differ = one != other
        # Ids differ on borders alone, or where two surfaces lie in one plane.
        assert not (differ & ~borders(one) & (error >= TOUCHING)).any()
        shares.append(differ.mean())
        if (both & ~differ).any():
            depth_errors.append(np.median(error[both & ~differ]))
        seen |= set(np.unique(drawn["semantic"]).tolist())
    assert np.mean(shares) <= 1e-3
    assert np.median(depth_errors) <= 1e-5
    return seen


@pytest.mark.slow_after_first
@pytest.mark.parametrize("scene", [*scene_names(), CROSSROADS], ids=lambda name: Path(name).stem)
def test_views_of_a_scene(scene):
    seen = assert_agree(load_scene(scene), 40)
    assert seen == {CATEGORY_ID[name] for name in load_scene(scene).categories}


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", ["straight_road", "three_way_junction"])
def test_views_between_near_and_far_planes_that_cut_through_everything(name):
    scene = load_scene(name)
    # H != W; people are cut open at 1.5 m, houses and trees end at 30 m.
    camera = replace(scene.camera, height_px=50, width_px=70, near_m=1.5, far_m=30.0, pitch_deg=20)
    seen = assert_agree(replace(scene, camera=camera), 30)
    assert {CATEGORY_ID["sky"], CATEGORY_ID["pedestrian"]} <= seen


def test_maps_do_not_depend_on_whether_colours_are_asked_for(make_street):
    alone, coloured = (
        make_street("three_way_junction", sensors=sensors) for sensors in (MAPS, (*MAPS, "rgb"))
    )
    maps, more = (env.reset(seed=4)[0] for env in (alone, coloured))
    assert differing(maps, {name: more[name] for name in MAPS}) == []
