"""A scene laid out on the ground: polygons, boxes and walking lines, computed once from its data.

Convention: world metres, x forward at yaw 0, yaw counter-clockwise.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
import shapely.ops
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon

from flowrep.envs.scene import BuildingRow, Closure, Road, Scene, Walk, Zone
from flowrep.envs.vehicle import VehicleState

Array = NDArray[np.float64]
_ARC_STEP_DEG = 3.0


@dataclass(frozen=True)
class Box:
    """An upright box on the ground: centre, heading, (length, width, height), a variant number.

    Convention: length runs along the heading. A house shows its front to its right.
    """

    category: str
    x_m: float
    y_m: float
    yaw_rad: float
    size_m: tuple[float, float, float]
    variant: int = 0

    @cached_property
    def footprint(self) -> Polygon:
        """The rectangle that the box covers."""
        forward, left = self.size_m[0] / 2, self.size_m[1] / 2
        sine, cosine = math.sin(self.yaw_rad), math.cos(self.yaw_rad)
        return Polygon(
            [
                (self.x_m + cosine * u - sine * v, self.y_m + sine * u + cosine * v)
                for u, v in ((forward, left), (-forward, left), (-forward, -left), (forward, -left))
            ]
        )


def centreline(road: Road) -> LineString:
    """Returns a road's centreline, arcs sampled every few degrees."""
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


def ribbon(line: LineString, half_width_m: float) -> Polygon:
    """Returns the ground within `half_width_m` of a line, cut square at its ends."""
    return line.buffer(half_width_m, cap_style="flat", join_style="mitre")


class Layout:
    """The ground plan of one scene."""

    def __init__(self, scene: Scene) -> None:
        """Lays out roads, zones, buildings and obstacles."""
        self.scene = scene
        self.lines = centrelines(scene)
        self._roads = {road.name: road for road in scene.roads}
        ribbons = [ribbon(self.lines[road.name], road.width_m / 2) for road in scene.roads]
        wide = [
            ribbon(self.lines[road.name], road.width_m / 2 + road.sidewalk_m)
            for road in scene.roads
        ]
        self.drivable = shapely.union_all(ribbons)
        self.sidewalks = shapely.union_all(wide).difference(self.drivable)
        self.zones = {zone.name: self._zone_polygon(zone) for zone in scene.zones}
        self.closures = {closure.name: self._closure_box(closure) for closure in scene.closures}
        self.buildings = self._buildings()
        self.obstacles = tuple(
            Box(o.category, *o.center_m, math.radians(o.yaw_deg), o.size_m) for o in scene.obstacles
        )
        shapely.prepare(self.drivable)

    def pose_at(self, road: str, at_m: float, offset_m: float = 0.0) -> tuple[float, float, float]:
        """Returns x, y and heading at a distance along a road, `offset_m` to its left."""
        line = self.lines[road]
        step = min(0.05, line.length / 4)
        middle = min(max(at_m, step), line.length - step)
        behind, ahead = (line.interpolate(middle + sign * step) for sign in (-1, 1))
        heading = math.atan2(ahead.y - behind.y, ahead.x - behind.x)
        point = line.interpolate(at_m)
        return (
            point.x - offset_m * math.sin(heading),
            point.y + offset_m * math.cos(heading),
            heading,
        )

    def start_state(self, zone_name: str) -> VehicleState:
        """Returns the vehicle at rest in its yaw, in the middle of a start zone."""
        zone = next(zone for zone in self.scene.zones if zone.name == zone_name)
        x, y, heading = self.pose_at(zone.road, (zone.from_m + zone.to_m) / 2)
        return VehicleState(x, y, heading + (math.pi if zone.reverse else 0.0), 0.0)

    def walk_line(self, walk: Walk, lateral_m: float = 0.0) -> Array:
        """Returns the points [M, 2] of a walk, moved `lateral_m` to the left of its direction."""
        if walk.kind == "points":
            line = LineString(walk.points_m)
            moved = line.offset_curve(lateral_m) if lateral_m else line
            return np.array(moved.coords)
        assert walk.road is not None
        if walk.kind == "along":
            assert walk.from_m is not None
            assert walk.to_m is not None
            part = shapely.ops.substring(self.lines[walk.road], walk.from_m, walk.to_m)
            return np.array(part.offset_curve(walk.offset_m + lateral_m).coords)
        assert walk.at_m is not None
        road = self._roads[walk.road]
        # A stride is kept from the house fronts.
        reach = road.width_m / 2 + road.sidewalk_m - 0.5
        # From the right-hand sidewalk to the left-hand one: its left is back along the road.
        ends = [self.pose_at(walk.road, walk.at_m - lateral_m, side * reach) for side in (-1, 1)]
        return np.array([end[:2] for end in ends])

    def _zone_polygon(self, zone: Zone) -> Polygon:
        part = shapely.ops.substring(self.lines[zone.road], zone.from_m, zone.to_m)
        return ribbon(part, self._roads[zone.road].width_m / 2)

    def _closure_box(self, closure: Closure) -> Box:
        road = self._roads[closure.road]
        x, y, heading = self.pose_at(closure.road, closure.at_m)
        width = road.width_m + 2 * road.sidewalk_m
        size = (width, closure.depth_m, closure.height_m)
        return Box("building", x, y, heading - math.pi / 2, size)

    def _buildings(self) -> tuple[Box, ...]:
        rng = np.random.default_rng(self.scene.layout_seed)
        rows = [self._building_row(row, rng) for row in self.scene.building_rows]
        return tuple(box for row in rows for box in row)

    def _building_row(self, row: BuildingRow, rng: np.random.Generator) -> list[Box]:
        if row.side in ("start", "end"):
            at = self.lines[row.road].length if row.side == "end" else 0.0
            x, y, heading = self.pose_at(row.road, at)
            depth, front = rng.uniform(*row.depth_m), rng.uniform(*row.front_m)
            away = (row.setback_m + depth / 2) * (1 if row.side == "end" else -1)
            x, y = x + away * math.cos(heading), y + away * math.sin(heading)
            size = (front, depth, rng.uniform(*row.height_m))
            facing = heading + math.pi / 2 * (-1 if row.side == "end" else 1)
            return [Box("building", x, y, facing, size, int(rng.integers(1 << 16)))]
        side = 1.0 if row.side == "left" else -1.0
        edge = self._roads[row.road].width_m / 2 + row.setback_m
        boxes, at = [], row.from_m
        while at < row.to_m:
            front, depth = rng.uniform(*row.front_m), rng.uniform(*row.depth_m)
            size = (front, depth, rng.uniform(*row.height_m))
            jut = rng.uniform(0.0, 0.8)
            offset = side * (edge + jut + depth / 2)
            x, y, heading = self.pose_at(row.road, at + front / 2, offset)
            facing = heading + (0.0 if row.side == "left" else math.pi)
            boxes.append(Box("building", x, y, facing, size, int(rng.integers(1 << 16))))
            at += front
        return boxes
