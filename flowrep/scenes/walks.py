"""Lines that people walk on: side by side, so that whoever keeps to one of them meets nobody.

A group's lanes are parallel to one line. Two lanes that are `LANE_M` apart keep two people apart
whatever their speeds, wherever they turn about: their bodies can't overlap.
"""

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from flowrep.scenes.people import RADIUS_M

Array = NDArray[Any]

APART_M = 2 * RADIUS_M
"""Two people whose centres are so far apart touch, and don't overlap."""

LANE_M = APART_M + 0.01
"""From the middle of one lane to that of the next."""

_SHORTEST_M = 1e-3


def without_repeats(points: Array) -> Array:
    """Returns points [M, 2] without those that are hardly a millimetre from the one before."""
    kept = [points[0]]
    for point in points[1:]:
        if np.hypot(*(point - kept[-1])) > _SHORTEST_M:
            kept.append(point)
    return np.array(kept)


def parallel(points: Array, aside_m: float) -> Array:
    """Returns a line [M, 2] moved to its left, corner by corner, every stretch by `aside_m`."""
    steps = np.diff(points, axis=0)
    normals = np.stack([-steps[:, 1], steps[:, 0]], axis=-1) / np.hypot(*steps.T)[:, None]
    before, after = np.vstack([normals[:1], normals]), np.vstack([normals, normals[-1:]])
    # The corner lies on the bisector, one metre from the line on either side of it.
    share = np.maximum(1.0 + (before * after).sum(axis=-1), 1e-9)
    return points + aside_m * (before + after) / share[:, None]


def keeps_its_stretches(points: Array, aside_m: float) -> bool:
    """Returns whether a line moved aside still has every stretch, and none of them reversed.

    A stretch's length is linear in `aside_m`: what holds at two distances holds between them.
    """
    steps = np.diff(points, axis=0)
    moved = np.diff(parallel(points, aside_m), axis=0)
    return bool(((steps * moved).sum(axis=-1) > _SHORTEST_M * np.hypot(*steps.T)).all())


def keeps_lanes_apart(points: Array, spread_m: float) -> bool:
    """Returns whether lanes up to half of `spread_m` to either side are as far apart as drawn.

    They are if the strip that holds them and half a person's room around them does not overlap
    itself: to come from one lane to another, one then crosses all between them, or leaves the strip
    and enters it again.
    """
    reach, room = spread_m / 2 + APART_M / 2, APART_M / 2
    first, last = points[1] - points[0], points[-1] - points[-2]
    longer = points.astype(np.float64)
    longer[0] -= room * first / np.hypot(*first)
    longer[-1] += room * last / np.hypot(*last)
    if not all(keeps_its_stretches(longer, side * reach) for side in (-1, 1)):
        return False
    right, left = (parallel(longer, side * reach) for side in (-1, 1))
    return bool(shapely.polygons(np.vstack([right, left[::-1]])).is_valid)


def covered_ground(points: Array, spread_m: float) -> list[BaseGeometry]:
    """Returns where the lanes of a walk can lie, as convex pieces, one for each of its stretches.

    A piece is a line where `spread_m` is 0.
    """
    right, left = (parallel(points, side * spread_m / 2) for side in (-1, 1))
    corners = np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1)
    return list(shapely.convex_hull(shapely.multipoints(corners)))


def gap_m(ground: list[BaseGeometry], other: list[BaseGeometry]) -> float:
    """Returns how far two lists of shapes are from each other."""
    tree = shapely.STRtree(other)
    _, distances = tree.query_nearest(ground, all_matches=False, return_distance=True)
    return float(distances.min())


def least_spread_m(count: int) -> float:
    """Returns the room that the lanes of so many people take."""
    return round((count - 1) * LANE_M, 6)


def draw_lanes(count: int, spread_m: float, rng: np.random.Generator) -> Array:
    """Returns how far to the left of the walk each person's lane is [P].

    All ways to place the lanes within `spread_m`, each at least `LANE_M` from the next, are equally
    likely, and so is any order of the people.
    """
    free = max(spread_m - least_spread_m(count), 0.0)
    lanes = np.sort(rng.uniform(0.0, 1.0, count)) * free + LANE_M * np.arange(count)
    return rng.permutation(lanes - spread_m / 2)
