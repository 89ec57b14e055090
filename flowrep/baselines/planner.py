"""A privileged baseline that knows every pose, present and future, and searches ahead.

It is an upper bound for a scene: a beam search simulates the rest of the episode up to the end zone
and keeps only drives without a collision. Without knowledge of speeds it is a reference: an agent
that does better at speeds far from the normal ones must read people's speed.
"""

import heapq
import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from flowrep.envs.street_env import Episode, StreetEnv
from flowrep.scenes.layout import Layout, free_ground
from flowrep.scenes.pedestrians import RADIUS_M as PERSON_RADIUS_M
from flowrep.scenes.pedestrians import Crowd
from flowrep.scenes.scene import Path
from flowrep.scenes.vehicle import NO_OP, YAW_SIGN, VehicleState, footprint_corners, roll, turn

Array = NDArray[Any]
_ACTIONS = np.arange(len(YAW_SIGN))
_HOLD_STEPS = 2  # each decision of the search holds for two steps, which halves the search's depth
_MARGIN_M = 0.1  # distance kept from the road's edge, and from people whose speed is known
# Size of a cell of states: x, y in metres, yaw in degrees, yaw rate in degrees a second. Only the
# best state of a cell is kept, so that the beam holds different drives and not variants of one.
_CELL = np.array([0.5, 0.5, 4.0, 6.0])
# The cost of a state is the distance to the end zone from two points ahead of the vehicle, at half
# of this distance and at all of it. A vehicle that faces the right way therefore costs less.
_LOOK_AHEAD_M = 6.0
# Added to the cost per degree a second, so that of two ways of equal length the straighter one
# wins. It is small: the largest yaw rate, 60 degrees a second, counts as much as 1.2 m.
_TURNING_M_PER_DPS = 0.02
# Cost of a point off the road, larger than any distance in a scene. Its distance is inf, and costs
# of inf would not differ by the yaw rate.
_OFF_ROAD_M = 1e6
_GRID_M = 0.5  # side of a cell of `GoalDistance`
_NEIGHBOURS = [(i, j, math.hypot(i, j)) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]


class Planner:
    """Follows a planned drive, and plans again if its actions were not taken.

    Args:
        beams: beam widths; a wider beam is tried if no drive of a narrower one reaches the end
            zone.
        margins_m: distances to keep from people, in the order in which they are tried.
        sees_speed: whether it knows how fast people walk. If not, it knows everyone's position and
            heading, assumes the mean of the scene's normal speeds for all who walk, and plans again
            after each decision.
    """

    def __init__(
        self,
        beams: Sequence[int] = (100, 600),
        margins_m: Sequence[float] = (_MARGIN_M,),
        *,
        sees_speed: bool = True,
    ) -> None:
        self.beams, self.margins_m, self.sees_speed = tuple(beams), tuple(margins_m), sees_speed
        self._plan: dict[int, int] = {}  # actions by step
        self._expected: Any = None  # episode, steps and yaw rate if the action is taken

    def __call__(self, env: StreetEnv) -> int:
        """Returns the next action in the env's current episode."""
        episode = env.episode
        state, steps = episode.now.vehicle, episode.steps
        if self._expected != (episode, steps, state.yaw_rate_rps) or steps not in self._plan:
            actions = self.search(episode)
            actions = actions if self.sees_speed else actions[:_HOLD_STEPS]
            self._plan = dict(enumerate(actions, start=steps))
        action = self._plan.get(steps, NO_OP)
        turned = turn(state, YAW_SIGN[action], episode.dt_s, episode.layout.scene.vehicle)
        self._expected = (episode, steps + 1, turned.yaw_rate_rps)
        return action

    def search(self, episode: Episode) -> list[int]:
        """Returns the actions of a drive to the end zone, or of the longest drive found."""
        crowd = episode.crowd
        if not self.sees_speed:
            normal = sum(episode.layout.scene.pedestrian_speed_mps["normal"]) / 2
            crowd = crowd.all_walking_at(normal, episode.now.ticks * episode.tick_s)
        search, longest = _Search(episode, crowd), list[int]()
        for margin_m, beam in product(self.margins_m, self.beams):
            actions, is_complete = search.run(beam, margin_m)
            if is_complete:
                return actions
            longest = max(longest, actions, key=len)
        return longest


class GoalDistance:
    """A grid with the length of the shortest way from each point of the free ground to the goal."""

    def __init__(self, free: shapely.Geometry, goal: shapely.Geometry) -> None:
        x0, y0, x1, y1 = free.bounds
        self._origin = np.array([x0, y0])
        columns, rows = (math.ceil(size / _GRID_M) for size in (x1 - x0, y1 - y0))
        x = x0 + (np.arange(columns) + 0.5) * _GRID_M
        y = y0 + (np.arange(rows) + 0.5) * _GRID_M
        grid = np.meshgrid(x, y, indexing="ij")
        # The outermost cells have an infinite distance and stand for everything outside the grid.
        is_open = np.pad(shapely.contains_xy(free, *grid), 1)
        is_goal = is_open & np.pad(shapely.contains_xy(goal, *grid), 1)
        self._way = np.where(is_goal, 0.0, np.inf)
        # Dijkstra's algorithm, from all cells of the end zone at once. With scipy's version, it
        # would take as many lines to build the graph, and nothing else in the simulation needs
        # scipy.
        queue = [(0.0, i, j) for i, j in np.argwhere(is_goal).tolist()]
        while queue:
            way, i, j = heapq.heappop(queue)
            if way > self._way[i, j]:
                continue
            for di, dj, step in _NEIGHBOURS:
                longer = way + step * _GRID_M
                if is_open[i + di, j + dj] and longer < self._way[i + di, j + dj]:
                    self._way[i + di, j + dj] = longer
                    heapq.heappush(queue, (longer, i + di, j + dj))

    def __call__(self, x_m: Array, y_m: Array) -> Array:
        """Returns the distances to the end zone in metres, inf off the free ground."""
        cell = np.floor((np.stack([x_m, y_m], -1) - self._origin) / _GRID_M).astype(np.int64) + 1
        cell = np.clip(cell, 0, np.array(self._way.shape) - 1)
        return self._way[cell[..., 0], cell[..., 1]]


@lru_cache(maxsize=16)  # it takes a second, and all planners of a scene share it
def _ground(layout: Layout, path: Path) -> tuple[shapely.Geometry, GoalDistance]:
    free = free_ground(layout, path)
    return free, GoalDistance(free, layout.zones[path.end])


class _Search:
    """Simulates one episode for V vehicles at once; states hold arrays [V]."""

    def __init__(self, episode: Episode, crowd: Crowd) -> None:
        self.episode, self.crowd = episode, crowd
        scene = episode.layout.scene
        self.vehicle = scene.vehicle
        self.person_radii_m = scene.pedestrian_sizes * PERSON_RADIUS_M
        self.free, self.way = _ground(episode.layout, episode.path)

    def run(self, beam: int, margin_m: float) -> tuple[list[int], bool]:
        """Returns the actions of the best drive found, and whether it arrives."""
        episode = self.episode
        state = VehicleState(*(np.array([value]) for value in episode.now.vehicle))
        steps, ticks = episode.steps, episode.now.ticks
        history = np.empty((1, 0), dtype=np.int64)  # [V, D], the decisions that led to each state
        while steps < episode.limit_steps:
            parents = np.repeat(np.arange(state.x_m.size), len(_ACTIONS))
            actions = np.tile(_ACTIONS, state.x_m.size)
            state = VehicleState(*(value[parents] for value in state))
            state, alive, arrived = self.drive(state, actions, ticks, margin_m)
            steps, ticks = steps + _HOLD_STEPS, ticks + _HOLD_STEPS * episode.ticks_per_step
            kept = np.flatnonzero(arrived)[:1] if arrived.any() else self.best(state, alive, beam)
            if not kept.size:
                break
            history = np.column_stack([history[parents], actions])[kept]
            state = VehicleState(*(value[kept] for value in state))
            if arrived.any():
                return np.repeat(history[0], _HOLD_STEPS).tolist(), True
        return np.repeat(history[0], _HOLD_STEPS).tolist(), False

    def drive(
        self, state: VehicleState, actions: Array, ticks: int, margin_m: float
    ) -> tuple[VehicleState, Array, Array]:
        """Returns the states [V] after one decision, and which are unharmed and which arrived."""
        alive, arrived = np.ones(actions.size, dtype=bool), np.zeros(actions.size, dtype=bool)
        signs = np.array(YAW_SIGN)[actions]
        for _ in range(_HOLD_STEPS):
            state = turn(state, signs, self.episode.dt_s, self.vehicle)
            for _ in range(self.episode.ticks_per_step):
                state = roll(state, self.episode.tick_s, self.episode.vehicle_speed_mps)
                ticks += 1
                alive &= arrived | ~self._touches(state, ticks, margin_m)
                corners = footprint_corners(state, self.vehicle, _MARGIN_M)
                inside = shapely.contains_xy(self.free, corners[..., 0], corners[..., 1])
                alive &= arrived | inside.all(axis=-1)
                arrived |= alive & shapely.contains_xy(self.episode.goal, state.x_m, state.y_m)
        return state, alive, arrived

    def best(self, state: VehicleState, alive: Array, most: int) -> Array:
        """Returns the indices of up to `most` states with the least cost, one per cell."""
        index = np.flatnonzero(alive)
        x, y, yaw, rate = (value[index] for value in state)
        ahead = [_LOOK_AHEAD_M * share for share in (0.5, 1.0)]
        to_go = sum(self.way(x + d * np.cos(yaw), y + d * np.sin(yaw)) for d in ahead)
        turning = _TURNING_M_PER_DPS * np.abs(np.degrees(rate))
        order = np.argsort(np.minimum(to_go, _OFF_ROAD_M) + turning, kind="stable")
        features = np.stack([x, y, np.degrees(yaw), np.degrees(rate)], axis=-1)[order]
        cells = np.round(features / _CELL).astype(np.int64)
        _, first = np.unique(cells, axis=0, return_index=True)
        return index[order[np.sort(first)[:most]]]

    def _touches(self, state: VehicleState, ticks: int, margin_m: float) -> Array:
        people = self.crowd.positions(ticks * self.episode.tick_s)
        # Leave out people who are out of reach of all vehicles.
        reach = self.vehicle.length_m + self.vehicle.width_m
        low = np.array([state.x_m.min(), state.y_m.min()]) - reach
        high = np.array([state.x_m.max(), state.y_m.max()]) + reach
        is_near = ((people > low) & (people < high)).all(axis=-1)
        people = people[is_near]
        # Distance [V, P] of each person from each footprint, in the vehicles' axes: how far the
        # person is beyond the footprint's front or back, and beyond its sides.
        dx, dy = people[:, 0] - state.x_m[:, None], people[:, 1] - state.y_m[:, None]
        cosine, sine = np.cos(state.yaw_rad)[:, None], np.sin(state.yaw_rad)[:, None]
        ahead = np.abs(cosine * dx + sine * dy) - self.vehicle.length_m / 2
        aside = np.abs(cosine * dy - sine * dx) - self.vehicle.width_m / 2
        gap = np.hypot(np.maximum(ahead, 0.0), np.maximum(aside, 0.0))
        return (gap < self.person_radii_m[is_near] + margin_m).any(axis=-1)
