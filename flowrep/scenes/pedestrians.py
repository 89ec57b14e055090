"""People: their parts, the parallel lanes in which they walk, and their poses at any time.

Convention: a person's pose is (x, y, yaw, swing): position, heading, and the angle in radians by
which the left leg is swung backwards and the right leg forwards about the axis of the hips.
"""

import math
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from flowrep.scenes.layout import SHORTEST_M, Layout, parallel
from flowrep.scenes.scene import Range

Array = NDArray[Any]

RADIUS_M, HEIGHT_M = 0.3, 1.75  # of the collision cylinder; as all lengths, of people of size 1
APART_M = 2 * RADIUS_M  # distance between the centres of two people who touch
_BESIDE_M = 0.01  # between people on neighbouring lanes; with rounding, they still don't touch
PARTS = ("upper body", "left leg", "right leg")
HIP_M = 0.82  # height of the hips
_HIP_ASIDE_M = 0.1  # their distance from the middle
_SIDES = np.array([1.0, -1.0])  # of the legs: left is +y


def world_from_parts(poses: Array, sizes: Array) -> Array:
    """Returns the parts of people at poses [..., P, 4], of sizes [P], as [..., 3·P, 4, 4]."""
    x, y, yaw, swing = np.moveaxis(poses, -1, 0)[..., None]
    transforms = np.zeros((*poses.shape[:-1], len(PARTS), 4, 4))
    sine, cosine = np.sin(yaw), np.cos(yaw)
    angle = np.concatenate([np.zeros_like(swing), swing * _SIDES], axis=-1)
    sine_y, cosine_y = np.sin(angle), np.cos(angle)
    # Rz(yaw) · Ry(angle): a leg swings about the axis of the hips, then the person turns.
    transforms[..., 0, 0] = cosine * cosine_y
    transforms[..., 0, 1] = -sine
    transforms[..., 0, 2] = cosine * sine_y
    transforms[..., 1, 0] = sine * cosine_y
    transforms[..., 1, 1] = cosine
    transforms[..., 1, 2] = sine * sine_y
    transforms[..., 2, 0] = -sine_y
    transforms[..., 2, 2] = cosine_y
    aside = sizes[:, None] * np.array([0.0, *(_HIP_ASIDE_M * _SIDES)])
    transforms[..., 0, 3] = x - sine * aside
    transforms[..., 1, 3] = y + cosine * aside
    transforms[..., 1:, 2, 3] = sizes[:, None] * HIP_M
    transforms[..., 3, 3] = 1.0
    return transforms.reshape(*poses.shape[:-2], -1, 4, 4)


def keeps_its_stretches(points: Array, aside_m: float) -> bool:
    """Returns whether no stretch of a line vanishes or reverses when the line is moved aside."""
    # A stretch's length is linear in `aside_m`, so what holds at two distances holds in between.
    steps = np.diff(points, axis=0)
    moved = np.diff(parallel(points, aside_m), axis=0)
    return bool(((steps * moved).sum(axis=-1) > SHORTEST_M * np.hypot(*steps.T)).all())


def keeps_lanes_apart(points: Array, spread_m: float, size: float) -> bool:
    """Returns whether the lanes within `spread_m` keep their distances all along a walk."""
    # They do if the strip of all lanes, widened by half of the distance that people keep, doesn't
    # overlap itself: one can then get from one lane to another only across all lanes in between, or
    # by leaving the strip.
    room = size * APART_M / 2
    reach = spread_m / 2 + room
    first, last = points[1] - points[0], points[-1] - points[-2]
    longer = points.astype(np.float64)
    longer[0] -= room * first / np.hypot(*first)
    longer[-1] += room * last / np.hypot(*last)
    if not all(keeps_its_stretches(longer, side * reach) for side in (-1, 1)):
        return False
    right, left = (parallel(longer, side * reach) for side in (-1, 1))
    return bool(shapely.polygons(np.vstack([right, left[::-1]])).is_valid)


def covered_ground(points: Array, spread_m: float) -> list[shapely.Geometry]:
    """Returns the ground that the lanes of a walk can cover, as one convex piece per stretch."""
    right, left = (parallel(points, side * spread_m / 2) for side in (-1, 1))
    corners = np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1)
    return list(shapely.convex_hull(shapely.multipoints(corners)))


def least_spread_m(count: int, size: float) -> float:
    """Returns the least `spread_m` that the lanes of `count` people need."""
    return round((count - 1) * (size * APART_M + _BESIDE_M), 6)


def draw_lanes(count: int, spread_m: float, size: float, rng: np.random.Generator) -> Array:
    """Returns each person's lane [P] as its distance in metres to the left of the walk."""
    # All placements within `spread_m` at which people don't touch are equally likely, and so
    # are all orders of the people. To draw one without rejection: subtract the required distances
    # from the width, draw sorted uniform numbers in what is left, and add the distances again.
    free = max(spread_m - least_spread_m(count, size), 0.0)
    apart_m = size * APART_M + _BESIDE_M
    lanes = np.sort(rng.uniform(0.0, 1.0, count)) * free + apart_m * np.arange(count)
    return rng.permutation(lanes - spread_m / 2)


_TURN_S = 0.6  # duration of the turn at either end of a walk
_STRIDE_M = 1.4  # one step with each leg
_SWING_RAD = 0.38  # of a leg, either way: feet 0.6 m apart
_OUT_OF_STEP_RAD = 2.4  # phase between neighbours, so that a group does not march in step


class Crowd:
    """All people of one episode, whose poses at any time have a closed form.

    Each person walks to the end of a line and back, again and again, and starts at a phase in [0,
    1) of this round trip.

    Args:
        lines: P lines, points [M, 2] in metres each.
        speeds_mps: [P]; people with speed 0 stand.
        phases: [P].
    """

    def __init__(self, lines: list[Array], speeds_mps: Array, phases: Array) -> None:
        most = max((len(line) for line in lines), default=2)
        # One array holds all lines; shorter ones repeat their last point, which adds no length.
        padded = [line[np.minimum(np.arange(most), len(line) - 1)] for line in lines]
        self._points = np.array(padded).reshape(len(lines), most, 2)  # [P, M, 2]
        steps = np.diff(self._points, axis=1)
        lengths = np.hypot(steps[..., 0], steps[..., 1])  # [P, M - 1]
        self._headings = np.arctan2(steps[..., 1], steps[..., 0])
        self._directions = steps / np.maximum(lengths, 1e-12)[..., None]
        self._marks = np.cumsum(np.pad(lengths, ((0, 0), (1, 0))), axis=1)
        self._last_piece = np.maximum((lengths > 0).sum(axis=1) - 1, 0)
        self._length = self._marks[:, -1]
        self._there_and_back = 2 * self._length
        self._speeds = speeds_mps
        self._turn_per_m = 1.0 / np.maximum(_TURN_S * self._speeds, 1e-9)
        self._start = phases * self._there_and_back
        self._people = np.arange(len(lines))
        self._out_of_step = _OUT_OF_STEP_RAD * self._people

    def positions(self, time_s: float | Array) -> Array:
        """Returns everyone's position [P, 2] at a time, or [T, P, 2] at times [T, 1]."""
        return self._on_lines(self._along(time_s))[0]

    def poses(self, time_s: float | Array) -> Array:
        """Returns everyone's pose [P, 4] at a time, or [T, P, 4] at times [T, 1]."""
        along = self._along(time_s)
        positions, headings = self._on_lines(along)
        poses = np.empty((*along.shape, 4))
        poses[..., :2] = positions
        poses[..., 2] = headings + self._facing(along)
        walked = self._start + self._speeds * time_s
        step = walked * (2 * math.pi / _STRIDE_M) + self._out_of_step
        # Standing people have one foot in front of the other.
        poses[..., 3] = _SWING_RAD * np.where(self._speeds > 0, np.sin(step), 1.0)
        return poses

    def all_walking_at(self, speed_mps: float, time_s: float) -> "Crowd":
        """Returns a crowd with these positions at a time, in which all who walk have one speed."""
        speeds = np.where(self._speeds > 0, speed_mps, 0.0)
        phases = (self._along(time_s) - speeds * time_s) / self._there_and_back % 1.0
        return Crowd(list(self._points), speeds, phases)

    def _along(self, time_s: float | Array) -> Array:
        # Metres walked since the start of the line, in [0, length of the round trip).
        return (self._start + self._speeds * time_s) % self._there_and_back

    def _on_lines(self, along: Array) -> tuple[Array, Array]:
        # Positions [..., P, 2], and headings of the way out [..., P].
        at = np.minimum(along, self._there_and_back - along)
        pieces = (at[..., None] >= self._marks[:, 1:-1]).sum(axis=-1)
        here = self._people, np.minimum(pieces, self._last_piece)
        points, directions = self._points[here], self._directions[here]
        return points + (at - self._marks[here])[..., None] * directions, self._headings[here]

    def _facing(self, along: Array) -> Array:
        # The angle to the heading of the way out is 0 on the way out and π on the way back. At
        # either end a person turns uniformly during _TURN_S, half of it before the end and half
        # after it, without stopping.
        past_far_end = along - self._length
        is_back = past_far_end > 0
        past_near_end = along - is_back * self._there_and_back
        is_near_far_end = np.abs(past_far_end) <= np.abs(past_near_end)
        past_end = np.where(is_near_far_end, past_far_end, past_near_end)
        turned = np.minimum(np.maximum(0.5 + past_end * self._turn_per_m, 0.0), 1.0)
        return math.pi * (turned + ~is_near_far_end)


def draw_crowd(layout: Layout, speed_mps: Range, rng: np.random.Generator) -> Crowd:
    """Returns a crowd with phases, directions, speeds and lanes drawn for one episode.

    `speed_mps` is the range of the speed mode, `pedestrian_speed_mps` of the scene's file.
    """
    lines: list[Array] = []
    speeds, phases = [np.empty(0)], [np.empty(0)]
    size = layout.scene.largest_size
    for group in layout.scene.pedestrian_groups:
        low, high = group.speed_mps or speed_mps
        draws = 1 if group.draw == "group" else group.count
        # A uniform phase of a round trip also sets the direction. With `draw: group`, people share
        # phase and speed, up to `spread_m` / 2 ahead or behind. `check_walks` keeps starts free.
        phase = np.resize(rng.uniform(0.0, 1.0, draws), group.count)
        speed = np.resize(rng.uniform(low, high, draws), group.count)
        lateral = draw_lanes(group.count, group.spread_m, size, rng)
        ahead = rng.uniform(-0.5, 0.5, group.count) * group.spread_m
        lanes = [layout.walk_line(group.walk, aside) for aside in lateral.tolist()]
        there_and_back = [2 * np.hypot(*np.diff(lane, axis=0).T).sum() for lane in lanes]
        speed[: group.standing] = 0.0
        lines += lanes
        speeds.append(speed)
        phases.append((phase + ahead / there_and_back) % 1.0)
    return Crowd(lines, np.concatenate(speeds), np.concatenate(phases))
