"""One drive through a scene: where everything is and how the drive stands, without any picture.

All of an episode is a function of the scene, the speed range, the frame rate, the episode's seed
and the actions.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from flowrep.envs.layout import Layout
from flowrep.envs.outcome import Outcome
from flowrep.envs.pedestrians import Crowd, draw_crowd
from flowrep.envs.scene import Path, Range
from flowrep.envs.street import Street
from flowrep.envs.vehicle import VehicleState, footprint_corners, roll, turn

Array = NDArray[Any]
# Between two checks of the footprint the vehicle moves 0.42 m at 10 m/s: it can't pass anyone by.
_CHECKS_HZ = 24.0
_POSES_KEPT = 16  # ticks whose poses are at hand: those of this step and of the one before


@dataclass(frozen=True)
class Moment:
    """Where the vehicle and the pedestrians' clock stand; ticks count the footprint's checks."""

    vehicle: VehicleState
    ticks: int


class Rules:
    """What does not change between the episodes of a scene: its plan, its clock, its limits."""

    def __init__(self, layout: Layout, frame_rate_hz: float) -> None:
        """Prepares the tests for a layout at a frame rate."""
        self.layout = layout
        self.dt_s = 1.0 / frame_rate_hz
        self.ticks_a_step = math.ceil(_CHECKS_HZ / frame_rate_hz - 1e-9)
        self.tick_s = self.dt_s / self.ticks_a_step
        self.tick_numbers = np.arange(1, self.ticks_a_step + 1)
        self.tick_times_s = self.tick_numbers * self.tick_s
        self.limit_steps = math.ceil(layout.scene.time_limit_s * frame_rate_hz - 1e-9)
        vehicle = layout.scene.vehicle
        reach = math.hypot(vehicle.length_m, vehicle.width_m) / 2
        self._surely_inside = layout.drivable.buffer(-reach)
        shapely.prepare(self._surely_inside)

    def is_surely_inside(self, states: VehicleState) -> Array:
        """Returns where the footprint is on the road whichever way it points; fields [T]."""
        return shapely.contains_xy(self._surely_inside, states.x_m, states.y_m)

    def is_out_of_bounds(self, state: VehicleState) -> bool:
        """Returns whether any part of the footprint is off the road."""
        corners = footprint_corners(state, self.layout.scene.vehicle)
        return not self.layout.drivable.covers(Polygon(corners))


class Episode:
    """The state of one drive."""

    def __init__(
        self,
        rules: Rules,
        episode_seed: int,
        speed_mps: Range,
        *,
        path: str | None = None,
        vehicle_speed_mps: float | None = None,
    ) -> None:
        """Draws the path and the pedestrians from the episode's seed, and stands at the start."""
        scene = rules.layout.scene
        rng = np.random.default_rng(episode_seed)
        drawn = scene.paths[int(rng.integers(len(scene.paths)))]
        self.rules = rules
        self.seed = episode_seed
        self.path = drawn if path is None else _path_named(scene.paths, path)
        self.crowd: Crowd = draw_crowd(rules.layout, scene.pedestrian_groups, speed_mps, rng)
        self.vehicle_speed_mps = (
            scene.vehicle.speed_mps if vehicle_speed_mps is None else vehicle_speed_mps
        )
        self.goal = rules.layout.zones[self.path.end]
        self.now = Moment(rules.layout.start_state(self.path.start), 0)
        self.before = self.now
        self.steps = 0
        self.outcome = Outcome.RUNNING
        self.hit = ""
        self._poses: dict[int, Array] = {}

    def pedestrian_poses(self, moment: Moment) -> Array:
        """Returns where everyone is at a moment, planar poses [P, 3], not to be written to."""
        if moment.ticks not in self._poses:
            if len(self._poses) > _POSES_KEPT:
                self._poses.clear()
            self._poses[moment.ticks] = self.crowd.poses(moment.ticks * self.rules.tick_s)
        return self._poses[moment.ticks]

    def step(self, action: int, street: Street) -> None:
        """Drives one step; it ends early where the episode does."""
        rules = self.rules
        self.before = self.now
        state = turn(self.now.vehicle, action, rules.dt_s, rules.layout.scene.vehicle)
        states = roll(state, rules.tick_times_s, self.vehicle_speed_mps)  # fields [T]
        ticks = self.now.ticks + rules.tick_numbers
        people = self.crowd.positions(ticks[:, None] * rules.tick_s)  # [T, P, 2]
        is_safe = ~street.is_near(states, people) & rules.is_surely_inside(states)
        has_arrived = shapely.contains_xy(self.goal, states.x_m, states.y_m)
        for i in range(rules.ticks_a_step):
            vehicle = VehicleState(
                float(states.x_m[i]), float(states.y_m[i]), float(states.yaw_rad[i]), state[3]
            )
            if not is_safe[i]:
                self._judge(vehicle, people[i], street)
            if not self.outcome and has_arrived[i]:
                self.outcome = Outcome.SUCCESS
            if self.outcome:
                break
        self.now = Moment(vehicle, int(ticks[i]))
        self.steps += 1
        if not self.outcome and self.steps >= rules.limit_steps:
            self.outcome = Outcome.TIMEOUT

    def _judge(self, vehicle: VehicleState, people: Array, street: Street) -> None:
        self.hit = street.hit(vehicle, people)
        if self.hit:
            self.outcome = Outcome.COLLISION
        elif self.rules.is_out_of_bounds(vehicle):
            self.outcome = Outcome.OUT_OF_BOUNDS


def _path_named(paths: tuple[Path, ...], name: str) -> Path:
    for path in paths:
        if path.name == name:
            return path
    raise ValueError(f"unknown path {name!r}; the scene has {[path.name for path in paths]}")
