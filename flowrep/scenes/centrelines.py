"""Centrelines of roads, and places along them.

Convention: distances in metres from a road's start. Places before it, or beyond the road's end, are
on its straight continuation; stretches end with the road.
"""

import math

import shapely.ops
from shapely.geometry import LineString

from flowrep.scenes.scene import Road, Scene

_ARC_STEP_DEG = 5.0


def centreline(road: Road) -> LineString:
    """Returns a road's centreline, with arcs sampled every few degrees."""
    (x, y), heading = road.start_m, math.radians(road.heading_deg)
    points = [(x, y)]
    for piece in road.pieces:
        if piece.straight_m is not None:
            lengths, turn = [piece.straight_m], 0.0
        else:
            assert piece.arc_radius_m is not None
            assert piece.arc_deg is not None
            count = max(1, math.ceil(abs(piece.arc_deg) / _ARC_STEP_DEG))
            turn = math.radians(piece.arc_deg) / count
            lengths = [2 * piece.arc_radius_m * math.sin(abs(turn) / 2)] * count
        for length in lengths:
            x += length * math.cos(heading + turn / 2)
            y += length * math.sin(heading + turn / 2)
            heading += turn
            points.append((x, y))
    return LineString(points)


def centrelines(scene: Scene) -> dict[str, LineString]:
    """Returns the centreline of every road, by name."""
    return {road.name: centreline(road) for road in scene.roads}


def pose_along(line: LineString, at_m: float) -> tuple[float, float, float]:
    """Returns x, y and heading at a distance along a centreline or its continuation.

    >>> pose_along(LineString([(0, 0), (9, 0)]), -2.0)
    (-2.0, 0.0, 0.0)
    """
    step = min(0.05, line.length / 4)
    middle = min(max(at_m, step), line.length - step)
    behind, ahead = (line.interpolate(middle + sign * step) for sign in (-1, 1))
    heading = math.atan2(ahead.y - behind.y, ahead.x - behind.x)
    # shapely would count negative distances from the far end, and stop at either
    on_road = min(max(at_m, 0.0), line.length)
    point, beyond = line.interpolate(on_road), at_m - on_road
    return point.x + beyond * math.cos(heading), point.y + beyond * math.sin(heading), heading


def stretch(line: LineString, from_m: float, to_m: float) -> LineString:
    """Returns the part of a centreline between two distances along it.

    >>> stretch(LineString([(0, 0), (9, 0)]), -1.0, 3.0).wkt
    'LINESTRING (0 0, 3 0)'
    """
    first, last = (min(max(at_m, 0.0), line.length) for at_m in (from_m, to_m))
    return shapely.ops.substring(line, first, last)
