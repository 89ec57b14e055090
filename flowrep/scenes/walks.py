"""Parallel lanes for people to walk in without meeting each other.

A group's lanes are parallel to one line. People in lanes `LANE_M` apart can't overlap, whatever
their speeds and wherever they turn around.
"""

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from flowrep.scenes.people import RADIUS_M

Array = NDArray[Any]

APART_M = 2 * RADIUS_M
"""Distance between the centres of two people who touch without overlapping."""

LANE_M = APART_M + 0.01
"""Distance between the middles of neighbouring lanes."""

_SHORTEST_M = 1e-3


def without_repeats(points: Array) -> Array:
    """Returns points [M, 2] without those within about a millimetre of the previous one."""
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
    # The corner lies on the bisector, one metre from both adjacent stretches.
    share = np.maximum(1.0 + (before * after).sum(axis=-1), 1e-9)
    return points + aside_m * (before + after) / share[:, None]


def keeps_its_stretches(points: Array, aside_m: float) -> bool:
    """Returns whether a line moved aside keeps every stretch, with none reversed.

    The length of a stretch is linear in `aside_m`, so if this holds at two distances, it holds
    between them.
    """
    steps = np.diff(points, axis=0)
    moved = np.diff(parallel(points, aside_m), axis=0)
    return bool(((steps * moved).sum(axis=-1) > _SHORTEST_M * np.hypot(*steps.T)).all())


def keeps_lanes_apart(points: Array, spread_m: float) -> bool:
    """Returns whether lanes up to half of `spread_m` to either side stay as far apart as drawn.

    They do if the strip of all lanes, widened by half a person's room, does not overlap itself: the
    only way from one lane to another is then across all lanes between them, or out of the strip and
    in again.
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
    """Returns the ground that the lanes of a walk can cover, one convex piece for each stretch.

    The pieces are lines if `spread_m` is 0.
    """
    right, left = (parallel(points, side * spread_m / 2) for side in (-1, 1))
    corners = np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1)
    return list(shapely.convex_hull(shapely.multipoints(corners)))


def gap_m(ground: list[BaseGeometry], other: list[BaseGeometry]) -> float:
    """Returns the distance in metres between two lists of shapes."""
    tree = shapely.STRtree(other)
    _, distances = tree.query_nearest(ground, all_matches=False, return_distance=True)
    return float(distances.min())


def least_spread_m(count: int) -> float:
    """Returns the least width in metres that the lanes of `count` people take."""
    return round((count - 1) * LANE_M, 6)


def draw_lanes(count: int, spread_m: float, rng: np.random.Generator) -> Array:
    """Returns each person's lane [P] as its distance in metres to the left of the walk.

    All placements of lanes within `spread_m` that are at least `LANE_M` apart are equally likely,
    and so are all orders of the people.
    """
    free = max(spread_m - least_spread_m(count), 0.0)
    lanes = np.sort(rng.uniform(0.0, 1.0, count)) * free + LANE_M * np.arange(count)
    return rng.permutation(lanes - spread_m / 2)
