"""One drive through a scene: positions, outcome and reward, without rendering.

An episode is a function of the scene, the speed range, the frame rate, its seed and the actions.
"""

import math
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from flowrep.scenes.layout import Layout
from flowrep.scenes.pedestrians import Crowd, draw_crowd
from flowrep.scenes.scene import CATEGORIES, CATEGORY_ID, Range, Scene
from flowrep.scenes.vehicle import YAW_SIGN, VehicleState, footprint_corners, roll, turn
from flowrep.simulator.street import Street


class Outcome(IntEnum):
    """The state of an episode; the TensorDict holds its code."""

    RUNNING = 0
    SUCCESS = 1
    COLLISION = 2
    OUT_OF_BOUNDS = 3
    TIMEOUT = 4

    @property
    def label(self) -> str:
        """Its name in `info`, tables and files."""
        return self.name.lower()


EPISODE_SEEDS = 1 << 62  # seeds are smaller; a space of all numbers of int64 can't be sampled
NOTHING_HIT = 255  # value of `hit` without a collision; no class has this id


def reward(outcome: Outcome) -> float:
    """Returns the reward of a step that leads to `outcome`."""
    return 0.01 + {Outcome.RUNNING: 0.0, Outcome.SUCCESS: 5.0}.get(outcome, -5.0)


def hit_name(code: int) -> str:
    """Returns the category of a code of `hit`, or "" for nothing."""
    return "" if code == NOTHING_HIT else CATEGORIES[code]


Array = NDArray[Any]
# Between two tests of the footprint, neither the vehicle nor a person moves more than 0.42 m (the
# vehicle at 10 m/s), and a shorter vehicle not more than its length. So it can't jump over
# anything.
_CHECKS_HZ = 24.0
_CHECKS_PER_M = 2.4
_STEPS_AHEAD = 16  # people ignore the vehicle, so their poses are computed for many steps at once


class Moment(NamedTuple):
    """The vehicle's state and the pedestrians' clock in ticks; each tick tests the footprint."""

    vehicle: VehicleState
    ticks: int


def ticks_for(scene: Scene, frame_rate_hz: float, speed_mps: Range, driven_mps: float) -> int:
    """Returns how many times a step tests the footprint, at the speeds of an episode."""
    groups = [group for group in scene.pedestrian_groups if group.standing < group.count]
    fastest_mps = max(((group.speed_mps or speed_mps)[1] for group in groups), default=0.0)
    driven_hz = driven_mps * max(_CHECKS_PER_M, 1.0 / scene.vehicle.length_m)
    checks_hz = max(_CHECKS_HZ, driven_hz, fastest_mps * _CHECKS_PER_M)
    return math.ceil(checks_hz / frame_rate_hz - 1e-9)


class Episode:
    """The constants and the state of one drive.

    Args:
        layout: the ground plan of the scene.
        frame_rate_hz: steps a second.
        episode_seed: seed of everything that is drawn: the path, and how people walk.
        speed_mps: lowest and highest speed of people whose group doesn't set its speed.
        vehicle_speed_mps: the speed at which the vehicle drives.
        path: the name of the path; None draws one.

    Raises:
        ValueError: the scene has no such path.
    """

    def __init__(
        self,
        layout: Layout,
        frame_rate_hz: float,
        episode_seed: int,
        speed_mps: Range,
        vehicle_speed_mps: float,
        path: str | None = None,
    ) -> None:
        scene = layout.scene
        paths = {each.name: each for each in scene.paths}
        if path not in (None, *paths):
            raise ValueError(f"unknown path {path!r}; the scene has {[*paths]}")
        # A seed's episode depends on the order of the draws: first the path, then the people.
        rng = np.random.default_rng(episode_seed)
        # Draw even if a path is given, so that a seed has the same people on every path.
        drawn = scene.paths[int(rng.integers(len(scene.paths)))]
        self.layout, self.seed = layout, episode_seed
        self.speed_mps, self.vehicle_speed_mps = speed_mps, vehicle_speed_mps
        self.frame_rate_hz, self.dt_s = frame_rate_hz, 1.0 / frame_rate_hz
        self.ticks_per_step = ticks_for(scene, frame_rate_hz, speed_mps, vehicle_speed_mps)
        self.tick_s = self.dt_s / self.ticks_per_step
        # Rounding must not add a step: 200 / 12 · 15 is 250.00000000000003.
        self.limit_steps = math.ceil(scene.time_limit_s * frame_rate_hz - 1e-9)
        self.path = drawn if path is None else paths[path]
        self.crowd: Crowd = draw_crowd(layout, speed_mps, rng)
        self.goal = layout.zones[self.path.end]
        self.now = self.before = Moment(layout.start_state(self.path.start), 0)
        self.steps, self.outcome, self.hit = 0, Outcome.RUNNING, ""
        self.poses = self.poses_before = self.crowd.poses(0.0)
        # Poses of people at consecutive ticks, [ticks, P, 4], and the first of these ticks.
        self._ahead_from, self._ahead = 0, self.poses[:0, None]

    def status(self) -> dict[str, int]:
        """Returns outcome, hit, seed and path as numbers, for TensorDicts."""
        return {
            "outcome": int(self.outcome),
            "hit": CATEGORY_ID[self.hit] if self.hit else NOTHING_HIT,
            "episode_seed": self.seed,
            "path": self.layout.scene.paths.index(self.path),
        }

    def resume(self, before: Moment, now: Moment) -> None:
        """Jumps to a later step, given its moment and the one before it."""
        self.before, self.now = before, now
        self.poses_before = self.crowd.poses(before.ticks * self.tick_s)
        self.poses = self.crowd.poses(now.ticks * self.tick_s)

    def step(self, action: int, street: Street) -> None:
        """Drives one step, or part of it if the episode ends."""
        # The yaw rate changes once, at the beginning. Then the vehicle drives along an arc, on
        # which the footprint is tested at every tick.
        turned = turn(self.now.vehicle, YAW_SIGN[action], self.dt_s, self.layout.scene.vehicle)
        times_s = [(1 + i) * self.tick_s for i in range(self.ticks_per_step)]
        track = [roll(turned, time_s, self.vehicle_speed_mps) for time_s in times_s]
        poses = self._poses_ahead()
        is_near = street.is_anyone_near(track, poses).tolist()
        for i, vehicle in enumerate(track):
            # Call PyBullet and shapely only where a collision or an end is possible.
            if is_near[i] or not street.is_safe(vehicle.x_m, vehicle.y_m):
                self._end_where_due(vehicle, poses[i], street)
            if self.outcome:
                break
        self.before, self.now = self.now, Moment(vehicle, self.now.ticks + i + 1)
        self.poses_before, self.poses = self.poses, poses[i]
        self.steps += 1
        if not self.outcome and self.steps >= self.limit_steps:
            self.outcome = Outcome.TIMEOUT

    def _poses_ahead(self) -> Array:  # at the checks of the next step, [T, P, 4]
        count, first = self.ticks_per_step, self.now.ticks + 1
        at = first - self._ahead_from
        if not 0 <= at <= len(self._ahead) - count:
            ticks = first + np.arange(count * _STEPS_AHEAD)
            self._ahead = self.crowd.poses(ticks[:, None] * self.tick_s)
            self._ahead_from, at = first, 0
        return self._ahead[at : at + count]

    def _end_where_due(self, vehicle: VehicleState, poses: Array, street: Street) -> None:
        self.hit = street.hit(vehicle, poses, self.path.closures)
        footprint = shapely.Polygon(footprint_corners(vehicle, self.layout.scene.vehicle))
        if self.hit:
            self.outcome = Outcome.COLLISION
        elif not self.layout.drivable.covers(footprint):
            self.outcome = Outcome.OUT_OF_BOUNDS
        elif shapely.contains_xy(self.goal, vehicle.x_m, vehicle.y_m):
            self.outcome = Outcome.SUCCESS
