"""Checks that a scene fits on the ground: on its roads, not too large, every path open."""

import math
from collections.abc import Iterator

import numpy as np
import shapely
from shapely.geometry import Point, Polygon

from flowrep.scenes.centrelines import centrelines
from flowrep.scenes.fields import MOST_METRES
from flowrep.scenes.layout import Box, Layout, free_ground
from flowrep.scenes.scene import Path, Scene
from flowrep.scenes.schema import SceneError

_MOST_PIECES = 300
_MOST_GROUND_M2 = 1e6
_MOST_BOXES = 1_000
_LEAST_END_M = 1.0  # of an ending zone; the vehicle's place is checked at least every 0.42 m
_BEYOND_M = 100.0  # how far rows may extend beyond either end of a road


def check_extent(scene: Scene, source: str) -> None:
    """Checks that a scene is small enough to lay out, and that its parts lie on its roads.

    Raises:
        SceneError: names the key and the remedy.
    """
    pieces = sum(len(road.pieces) for road in scene.roads)
    if pieces > _MOST_PIECES:
        problem = f"have {pieces} pieces together"
        raise SceneError(source, "roads", problem, f"keep to {_MOST_PIECES}")
    lines = centrelines(scene)
    lengths = {name: line.length for name, line in lines.items()}
    if sum(lengths.values()) > MOST_METRES:
        problem = f"are {sum(lengths.values()):.0f} m long together"
        raise SceneError(source, "roads", problem, f"keep to {MOST_METRES:.0f} m")
    x0, y0, x1, y1 = shapely.total_bounds(list(lines.values()))
    width, height = x1 - x0, y1 - y0
    if max(width, 100.0) * max(height, 100.0) > _MOST_GROUND_M2:
        problem = f"cover {width:.0f} m by {height:.0f} m"
        remedy = f"keep to {_MOST_GROUND_M2 / 1e6:.0f} square kilometre"
        raise SceneError(source, "roads", problem, remedy)
    for key, road, stretch, beyond_m in _stretches(scene):
        low, high = 0.0 - beyond_m, lengths[road] + beyond_m
        if not all(low <= at <= high + 1e-6 for at in stretch):
            there = " to ".join(f"{at:g}" for at in stretch)
            remedy = f"stay within {low:g} and {high:.1f}"
            raise SceneError(source, key, f"{there} m is not on road {road!r}", remedy)
        if beyond_m == 0.0 and len(stretch) == 2 and stretch[0] == stretch[1]:
            raise SceneError(source, key, "has no length", "give from_m and to_m that differ")
    _check_numbers_of_boxes(scene, source)


def _stretches(scene: Scene) -> Iterator[tuple[str, str, tuple[float, ...], float]]:
    """Yields key, road, distances along the road, and their allowed overhang at its ends."""
    for zone in scene.zones:
        yield f"zones.{zone.name}", zone.road, (zone.from_m, zone.to_m), 0.0
    for closure in scene.closures:
        yield f"closures.{closure.name}.at_m", closure.road, (closure.at_m,), 0.0
    for i, crosswalk in enumerate(scene.crosswalks):
        yield f"crosswalks[{i}].at_m", crosswalk.road, (crosswalk.at_m,), 0.0
    for group in scene.pedestrian_groups:
        walk, key = group.walk, f"pedestrian_groups.{group.name}.walk"
        if walk.kind == "across" and walk.road is not None and walk.at_m is not None:
            yield f"{key}.at_m", walk.road, (walk.at_m,), 0.0
        if walk.kind == "along" and walk.road is not None:
            yield (
                key,
                walk.road,
                tuple(at for at in (walk.from_m, walk.to_m) if at is not None),
                0.0,
            )
    for name in ("building_rows", "obstacle_rows"):
        for i, row in enumerate(getattr(scene, name)):
            yield f"{name}[{i}]", row.road, (row.from_m, row.to_m), _BEYOND_M


def _check_numbers_of_boxes(scene: Scene, source: str) -> None:
    for key, each in (("building_rows", "front_m"), ("obstacle_rows", "every_m")):
        most = 0.0
        for row in getattr(scene, key):
            apart = row.front_m[0] if key == "building_rows" else row.every_m
            most += max(0.0, (row.to_m - row.from_m) / apart)
        if most > _MOST_BOXES:
            problem = f"could be {math.ceil(most)} together"
            remedy = f"keep to {_MOST_BOXES}: shorten the rows, or give a larger {each}"
            raise SceneError(source, key, problem, remedy)


def check_paths(layout: Layout, source: str) -> None:
    """Checks that every path begins on free road and leads to its ending zone.

    Raises:
        SceneError: names the path and the remedy.
    """
    ends = {path.end for path in layout.scene.paths}
    for zone in layout.scene.zones:
        if zone.from_m > zone.to_m:
            problem = f"[{zone.from_m}, {zone.to_m}] m runs backwards"
            raise SceneError(source, f"zones.{zone.name}", problem, "give from_m below to_m")
        length = zone.to_m - zone.from_m
        if zone.name in ends and length < _LEAST_END_M - 1e-6:
            problem = f"ends a path and is {length:g} m long"
            remedy = f"give it {_LEAST_END_M:g} m, or vehicles can drive through between checks"
            raise SceneError(source, f"zones.{zone.name}", problem, remedy)
    for path in layout.scene.paths:
        _check_path(layout, path, source)


def _check_path(layout: Layout, path: Path, source: str) -> None:
    key = f"paths.{path.name}"
    blocks = [*layout.buildings, *layout.obstacles]
    blocks += [layout.closures[name] for name in path.closures]
    footprint = layout.start_footprint(path.start)
    if not layout.drivable.covers(footprint):
        raise SceneError(source, key, "starts off the road", "move or widen its start zone")
    if _is_built_over(footprint, blocks):
        raise SceneError(source, key, "its start collides", "move the start or what is in it")
    if _is_built_over(layout.zones[path.end], blocks):
        raise SceneError(source, key, "its ending zone is built over", "move what is in it")
    if layout.zones[path.end].intersects(_start(layout, path)):
        problem = f"starts inside its ending zone {path.end!r}"
        raise SceneError(source, key, problem, "let it start or end elsewhere")
    if not _is_open(layout, path):
        problem = f"no free road leads from {path.start!r} to {path.end!r}"
        raise SceneError(source, key, problem, "join the roads or open a closure")


def _start(layout: Layout, path: Path) -> Point:
    return Point(layout.start_state(path.start)[:2])


def _is_built_over(ground: Polygon, boxes: list[Box]) -> bool:
    return bool(np.any(shapely.intersects(ground, [box.footprint for box in boxes])))


def _is_open(layout: Layout, path: Path) -> bool:
    # One connected piece of ground, wide enough for the vehicle's narrower side, must hold both
    # the start and the end.
    vehicle = layout.scene.vehicle
    room = free_ground(layout, path).buffer(-min(vehicle.width_m, vehicle.length_m) / 2)
    start = _start(layout, path)
    parts = shapely.get_parts(room)
    return any(part.covers(start) and part.intersects(layout.zones[path.end]) for part in parts)
