"""The ground plan of a scene: polygons, boxes and walking lines, computed once from its data.

Convention: world metres, x forward at yaw 0, yaw counter-clockwise. Distances along a road start at
its beginning; negative ones, and those beyond its end, are on its straight continuation.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import shapely
import shapely.ops
from numpy.typing import NDArray

from flowrep.scenes.scene import (
    CATEGORY_OF_KIND,
    BuildingRow,
    Closure,
    Crosswalk,
    Kind,
    ObstacleRow,
    Path,
    Road,
    Scene,
    SceneError,
    Walk,
)
from flowrep.scenes.vehicle import VehicleState, footprint_corners

Array = NDArray[np.float64]
_ARC_STEP_DEG = 5.0
_TOUCH_M = 0.05  # houses may overlap by this much, because those of a row stand wall to wall
_PLOT_STEP_M = 0.5  # step in which a house is moved along the road until there is room for it
SHORTEST_M = 1e-3  # shorter stretches of a walk are left out: they have no heading


def centreline(road: Road) -> shapely.LineString:
    """Returns a road's centreline, with arcs sampled every few degrees."""
    (x, y), heading = road.start_m, math.radians(road.heading_deg)
    points = [(x, y)]
    for piece in road.pieces:
        arc_deg = piece.arc_deg or 0.0
        count = max(1, math.ceil(abs(arc_deg) / _ARC_STEP_DEG))
        turn = math.radians(arc_deg) / count
        # The arc is sampled by chords; each has the heading in the middle of its part of the arc.
        chord = 2 * (piece.arc_radius_m or 0.0) * math.sin(abs(turn) / 2)
        length = piece.straight_m or chord
        for _ in range(count):
            x += length * math.cos(heading + turn / 2)
            y += length * math.sin(heading + turn / 2)
            heading += turn
            points.append((x, y))
    return shapely.LineString(points)


def stretch(line: shapely.LineString, from_m: float, to_m: float) -> shapely.LineString:
    """Returns the part of a centreline between two distances along it, cut at its ends."""
    first, last = (min(max(at_m, 0.0), line.length) for at_m in (from_m, to_m))
    return shapely.ops.substring(line, first, last)


def distinct_points(points: Array) -> Array:
    """Returns points [M, 2] without those closer than a millimetre to the previous one."""
    kept = [points[0]]
    for point in points[1:]:
        if np.hypot(*(point - kept[-1])) > SHORTEST_M:
            kept.append(point)
    return np.array(kept)


def parallel(points: Array, aside_m: float) -> Array:
    """Returns a line [M, 2] whose stretches are all moved to their left by `aside_m`."""
    steps = np.diff(points, axis=0)
    normals = np.stack([-steps[:, 1], steps[:, 0]], axis=-1) / np.hypot(*steps.T)[:, None]
    before, after = np.vstack([normals[:1], normals]), np.vstack([normals, normals[-1:]])
    # A corner moves along the bisector of the normals a and b of its two stretches. For a distance
    # of 1 from both it moves by (a + b) / (1 + a · b). The bound is for hairpins, where a = -b.
    share = np.maximum(1.0 + (before * after).sum(axis=-1), 1e-9)
    return points + aside_m * (before + after) / share[:, None]


@dataclass(frozen=True)
class Box:
    """An upright box on the ground that can be hit; the front of a house is on its right."""

    kind: Kind
    x_m: float  # of its centre
    y_m: float
    yaw_rad: float
    size_m: tuple[float, float, float]  # length, along the heading, width, height
    variant: int = 0  # any integer; it selects the appearance

    @property
    def category(self) -> str:
        """Its class in the semantic map."""
        return CATEGORY_OF_KIND[self.kind]

    @cached_property
    def footprint(self) -> shapely.Polygon:
        """The rectangle that the box covers."""
        forward, left = self.size_m[0] / 2, self.size_m[1] / 2
        sine, cosine = math.sin(self.yaw_rad), math.cos(self.yaw_rad)
        corners = (forward, left), (-forward, left), (-forward, -left), (forward, -left)
        x, y = self.x_m, self.y_m
        turned = [(x + cosine * u - sine * v, y + sine * u + cosine * v) for u, v in corners]
        return shapely.Polygon(turned)


class CrosswalkArea(NamedTuple):
    """The ground of a crosswalk and the heading of the road that it crosses."""

    polygon: shapely.Polygon
    heading_rad: float


def _with_round_corners(ground: shapely.Geometry, radius_m: float) -> shapely.Geometry:
    # Growing and then shrinking the ground fills its inward corners.
    return ground.buffer(radius_m).buffer(-radius_m) if radius_m > 0 else ground


def ribbon(line: shapely.LineString, half_width_m: float) -> shapely.Polygon:
    """Returns the ground within `half_width_m` of a line, cut square at its ends."""
    return line.buffer(half_width_m, cap_style="flat", join_style="mitre")


class Layout:
    """The ground plan of one scene."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.roads = {road.name: road for road in scene.roads}
        self.lines = {name: centreline(road) for name, road in self.roads.items()}
        self._walks: dict[Walk, Array] = {}
        roads = [(road, self.lines[road.name]) for road in scene.roads]
        self.ribbons = {road.name: ribbon(line, road.width_m / 2) for road, line in roads}
        wide = [ribbon(line, road.width_m / 2 + road.sidewalk_m) for road, line in roads]
        radius = scene.corner_radius_m
        self.drivable = _with_round_corners(shapely.union_all([*self.ribbons.values()]), radius)
        paved = shapely.union_all([*wide, _with_round_corners(shapely.union_all(wide), radius)])
        self._paved = shapely.union(paved, self.drivable)
        self.sidewalks = self.terrain = shapely.Polygon()
        # Sidewalks are left out, because rounding corners would leave slivers of them.
        if any(road.sidewalk_m > 0 for road in scene.roads):
            self.sidewalks = self._paved.difference(self.drivable)
        if scene.terrain_m > 0:
            reached = shapely.box(*self._paved.bounds).buffer(scene.terrain_m)
            self.terrain = reached.difference(self._paved)
        self.crosswalks = tuple(map(self._crosswalk_area, scene.crosswalks))
        self.zone_of = {zone.name: zone for zone in scene.zones}
        self.zones = {z.name: self._road_between(z.road, z.from_m, z.to_m) for z in scene.zones}
        self.closures = {closure.name: self._closure_box(closure) for closure in scene.closures}
        self.buildings = self._buildings()
        single = [
            Box(o.kind, *o.center_m, math.radians(o.yaw_deg), o.size_m, i)
            for i, o in enumerate(scene.obstacles)
        ]
        rows = [list(self._obstacle_row(row)) for row in scene.obstacle_rows]
        for i, row in enumerate(scene.obstacle_rows):
            _check_any(f"obstacle_rows[{i}]", row, rows[i])
        self.obstacles = (*single, *chain(*rows))
        shapely.prepare(self.drivable)

    def pose_at(self, road: str, at_m: float, offset_m: float = 0.0) -> tuple[float, float, float]:
        """Returns x, y and heading at a distance along a road, `offset_m` to its left."""
        line = self.lines[road]
        # The heading is that of a short chord around the point, which also works between two
        # pieces.
        step = min(0.05, line.length / 4)
        middle = min(max(at_m, step), line.length - step)
        behind, ahead = (line.interpolate(middle + sign * step) for sign in (-1, 1))
        heading = math.atan2(ahead.y - behind.y, ahead.x - behind.x)
        # shapely counts negative distances from the far end, and doesn't go beyond the ends.
        on_road = min(max(at_m, 0.0), line.length)
        point, beyond = line.interpolate(on_road), at_m - on_road
        x, y = point.x + beyond * math.cos(heading), point.y + beyond * math.sin(heading)
        return x - offset_m * math.sin(heading), y + offset_m * math.cos(heading), heading

    def start_state(self, zone_name: str) -> VehicleState:
        """Returns the vehicle in the middle of a start zone, with zero yaw rate."""
        zone = self.zone_of[zone_name]
        x, y, heading = self.pose_at(zone.road, (zone.from_m + zone.to_m) / 2)
        return VehicleState(x, y, heading + (math.pi if zone.reverse else 0.0), 0.0)

    def start_footprint(self, zone_name: str) -> shapely.Polygon:
        """Returns the ground that the vehicle covers in the middle of a start zone."""
        return shapely.Polygon(footprint_corners(self.start_state(zone_name), self.scene.vehicle))

    def boxes(self, path: Path) -> list[Box]:
        """Returns all boxes in the episodes of a path, closures included."""
        closures = [self.closures[name] for name in path.closures]
        return [*self.buildings, *self.obstacles, *closures]

    def walk_line(self, walk: Walk, lateral_m: float = 0.0) -> Array:
        """Returns the points [M, 2] of a walk, moved `lateral_m` to the left of its direction."""
        if walk not in self._walks:
            self._walks[walk] = distinct_points(self._walk_points(walk))
        return parallel(self._walks[walk], lateral_m)

    def _walk_points(self, walk: Walk) -> Array:
        given: Any = walk  # its kind determines which keys are not None
        if walk.kind == "points":
            return np.array(given.points_m)
        if walk.kind == "along":
            part = stretch(self.lines[given.road], given.from_m, given.to_m)
            return parallel(distinct_points(np.array(part.coords)), given.offset_m)
        road = self.roads[given.road]
        # Keep a stride away from the house fronts.
        reach = road.width_m / 2 + road.sidewalk_m - 0.5
        # People cross from right to left, so that the walk's left points back along the road.
        return np.array([self.pose_at(road.name, given.at_m, y)[:2] for y in (-reach, reach)])

    def _road_between(self, road: str, from_m: float, to_m: float) -> shapely.Polygon:
        return ribbon(stretch(self.lines[road], from_m, to_m), self.roads[road].width_m / 2)

    def _closure_box(self, closure: Closure) -> Box:
        road = self.roads[closure.road]
        x, y, heading = self.pose_at(closure.road, closure.at_m)
        size = (road.width_m + 2 * road.sidewalk_m, closure.depth_m, closure.height_m)
        return Box("house", x, y, heading - math.pi / 2, size)

    def _crosswalk_area(self, crosswalk: Crosswalk) -> CrosswalkArea:
        first, last = (crosswalk.at_m + side * crosswalk.depth_m / 2 for side in (-1, 1))
        _, _, heading = self.pose_at(crosswalk.road, crosswalk.at_m)
        return CrosswalkArea(self._road_between(crosswalk.road, first, last), heading)

    def _buildings(self) -> tuple[Box, ...]:
        # Random numbers are drawn in the order of the rows, so that a row that is added at the end
        # doesn't change the others.
        rng = np.random.default_rng(self.scene.layout_seed)
        boxes: list[Box] = []
        for i, row in enumerate(self.scene.building_rows):
            count = len(boxes)
            if row.side in ("start", "end"):
                boxes.append(self._house_across(row, rng))
            else:
                self._add_houses(row, rng, boxes)
            _check_any(f"building_rows[{i}]", row, boxes[count:])
        return tuple(boxes)

    def _house_across(self, row: BuildingRow, rng: np.random.Generator) -> Box:
        at, ahead = (self.lines[row.road].length, 1) if row.side == "end" else (0.0, -1)
        x, y, heading = self.pose_at(row.road, at)
        depth, front = rng.uniform(*row.depth_m), rng.uniform(*row.front_m)
        away = (row.setback_m + depth / 2) * ahead
        x, y = x + away * math.cos(heading), y + away * math.sin(heading)
        size = (front, depth, rng.uniform(*row.height_m))
        facing = heading - math.pi / 2 * ahead
        return Box("house", x, y, facing, size, int(rng.integers(1 << 16)))

    def _add_houses(self, row: BuildingRow, rng: np.random.Generator, houses: list[Box]) -> None:
        side = 1.0 if row.side == "left" else -1.0
        edge = self.roads[row.road].width_m / 2 + row.setback_m
        # The last house may extend beyond to_m, but not beyond the road's end.
        last_middle = max(row.to_m, self.lines[row.road].length)
        at = row.from_m
        while at < row.to_m:
            front, depth = rng.uniform(*row.front_m), rng.uniform(*row.depth_m)
            size = (front, depth, rng.uniform(*row.height_m))
            offset = side * (edge + rng.uniform(0.0, 0.8) + depth / 2)
            variant = int(rng.integers(1 << 16))
            while at < row.to_m:  # until there is room for this house
                x, y, heading = self.pose_at(row.road, at + front / 2, offset)
                facing = heading + (0.0 if row.side == "left" else math.pi)
                house = Box("house", x, y, facing, size, variant)
                ground = house.footprint.buffer(-_TOUCH_M)
                taken = [self._paved, *(other.footprint for other in houses)]
                is_free = not shapely.intersects(ground, taken).any()
                if is_free and at + front / 2 <= last_middle:
                    houses.append(house)
                    at += front
                    break
                at += _PLOT_STEP_M

    def _obstacle_row(self, row: ObstacleRow) -> Iterator[Box]:
        other_roads = self.drivable.difference(self.ribbons[row.road])
        taken = [other_roads, *(box.footprint for box in self.buildings)]
        facing = math.pi if row.offset_m > 0 else 0.0
        for i, at in enumerate(np.arange(row.from_m, row.to_m, row.every_m).tolist()):
            x, y, heading = self.pose_at(row.road, at, row.offset_m)
            box = Box(row.kind, x, y, heading + facing, row.size_m, i)
            if not shapely.intersects(box.footprint, taken).any():
                yield box


def _check_any(key: str, row: BuildingRow | ObstacleRow, boxes: list[Box]) -> None:
    if not boxes:
        raise SceneError(
            f"{key}: none of it is placed, because roads or houses are in the way from "
            f"{row.from_m:g} to {row.to_m:g} m; move the row, or give smaller sizes"
        )


def free_ground(layout: Layout, path: Path) -> shapely.Geometry:
    """Returns the road minus the buildings, obstacles and closures of a path's episodes."""
    taken = shapely.union_all([box.footprint for box in layout.boxes(path)])
    free = layout.drivable.difference(taken)
    shapely.prepare(free)
    return free
