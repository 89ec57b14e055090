"""Checks of a scene as a whole: its parts agree, it fits on the ground, people keep apart.

Pydantic has checked each value for itself by then.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import combinations

import numpy as np
import shapely
from shapely.geometry import Point, Polygon
from shapely.geometry.base import BaseGeometry

from flowrep.palette import CATEGORY_ID
from flowrep.scenes.layout import Box, Layout, free_ground
from flowrep.scenes.pedestrians import (
    APART_M,
    PARTS,
    RADIUS_M,
    covered_ground,
    gap_m,
    keeps_its_stretches,
    keeps_lanes_apart,
    least_spread_m,
)
from flowrep.scenes.scene import (
    CATEGORY_OF_KIND,
    LEAST_HEIGHT_M,
    BuildingRow,
    Obstacle,
    ObstacleRow,
    Path,
    PedestrianGroup,
    Piece,
    Scene,
    SceneError,
)

_KEYS_OF_WALK = {
    "across": ("road", "at_m"),
    "along": ("road", "from_m", "to_m"),
    "points": ("points_m",),
}
_MORE_KEYS_OF_WALK = {"along": ("offset_m",)}
_LEAST_END_M = 1.0  # of an ending zone; the vehicle's place is checked at least every 0.42 m


def check_consistency(scene: Scene, source: str) -> None:
    """Checks that every name is known and every part is complete.

    Raises:
        SceneError: names the key and the remedy.
    """
    _check_camera_and_people(scene, source)
    _check_unique(scene, source)
    _check_categories(scene, source)
    _check_references(scene, source)
    for road in scene.roads:
        for i, piece in enumerate(road.pieces):
            _check_piece(piece, source, f"roads.{road.name}.pieces[{i}]")
    for name in ("building_rows", "obstacle_rows"):
        for i, row in enumerate(getattr(scene, name)):
            _check_row(row, source, f"{name}[{i}]")
    for name in ("obstacles", "obstacle_rows"):
        for i, obstacle in enumerate(getattr(scene, name)):
            _check_height(obstacle, source, f"{name}[{i}].size_m[2]")
    for group in scene.pedestrian_groups:
        _check_walk(group, [road.name for road in scene.roads], source)


def _check_camera_and_people(scene: Scene, source: str) -> None:
    if scene.camera.far_m <= scene.camera.near_m:
        raise SceneError(source, "camera.far_m", "is not beyond near_m", "give a larger far_m")
    if len(PARTS) * scene.num_pedestrians > 255:
        problem = (
            f"{scene.num_pedestrians} people, but their {len(PARTS)} parts each have 8-bit ids"
        )
        raise SceneError(source, "pedestrian_groups", problem, f"keep to {255 // len(PARTS)}")
    for group in scene.pedestrian_groups:
        if group.standing > group.count:
            key = f"pedestrian_groups.{group.name}.standing"
            raise SceneError(source, key, f"is {group.standing}", f"stay in 0..{group.count}")


def _check_piece(piece: Piece, source: str, key: str) -> None:
    arc = (piece.arc_radius_m, piece.arc_deg)
    is_straight = piece.straight_m is not None and arc == (None, None)
    is_arc = piece.straight_m is None and None not in arc
    if not (is_straight or is_arc):
        remedy = "give straight_m alone, or arc_radius_m and arc_deg"
        raise SceneError(source, key, "neither a straight piece nor an arc", remedy)
    if piece.arc_deg == 0:
        raise SceneError(source, f"{key}.arc_deg", "is 0", "give straight_m, or a turn")


def _check_row(row: BuildingRow | ObstacleRow, source: str, key: str) -> None:
    if isinstance(row, BuildingRow) and row.side in ("start", "end"):
        if row.from_m or row.to_m:
            problem = f"is one house across the road's {row.side}, wherever from_m and to_m are"
            raise SceneError(source, key, problem, "give 0 for both, or side left or right")
    elif row.from_m >= row.to_m:
        problem = f"goes from {row.from_m:g} to {row.to_m:g} m"
        raise SceneError(source, key, problem, "give from_m below to_m")


def _check_height(obstacle: Obstacle | ObstacleRow, source: str, key: str) -> None:
    height_m, least_m = obstacle.size_m[2], LEAST_HEIGHT_M.get(obstacle.kind, 0.0)
    if height_m < least_m:
        problem = f"is {height_m:g}, too low for a {obstacle.kind}"
        raise SceneError(source, key, problem, f"give {least_m} or more")


def _check_categories(scene: Scene, source: str) -> None:
    _known(source, "categories", scene.categories, CATEGORY_ID)
    used = {
        "scene": ["sky", "road"],
        "obstacles": [CATEGORY_OF_KIND[o.kind] for o in scene.obstacles],
        "obstacle_rows": [CATEGORY_OF_KIND[row.kind] for row in scene.obstacle_rows],
        "crosswalks": ["crosswalk"] * bool(scene.crosswalks),
        "terrain_m": ["terrain"] * (scene.terrain_m > 0),
        "roads": ["sidewalk"] * any(road.sidewalk_m > 0 for road in scene.roads),
        "pedestrian_groups": ["pedestrian"] * bool(scene.pedestrian_groups),
        "building_rows or closures": ["building"] * bool(scene.building_rows or scene.closures),
    }
    for key, names in used.items():
        _known(source, key, names, scene.categories)


def _check_unique(scene: Scene, source: str) -> None:
    listed = {"categories": list(scene.categories)}
    for part in ("roads", "zones", "paths", "pedestrian_groups", "closures"):
        listed[part] = [item.name for item in getattr(scene, part)]
    for key, names in listed.items():
        for name, count in Counter(names).items():
            if count > 1:
                raise SceneError(source, key, f"two are named {name!r}", "rename one of them")


def _check_references(scene: Scene, source: str) -> None:
    roads = [road.name for road in scene.roads]
    zones = [zone.name for zone in scene.zones]
    closures = [closure.name for closure in scene.closures]
    for zone in scene.zones:
        _known(source, f"zones.{zone.name}.road", [zone.road], roads)
    for path in scene.paths:
        _known(source, f"paths.{path.name}", [path.start, path.end], zones)
        _known(source, f"paths.{path.name}.closures", path.closures, closures)
    for key in ("building_rows", "obstacle_rows", "closures", "crosswalks"):
        for i, item in enumerate(getattr(scene, key)):
            _known(source, f"{key}[{i}].road", [item.road], roads)


def _check_walk(group: PedestrianGroup, roads: list[str], source: str) -> None:
    key = f"pedestrian_groups.{group.name}.walk"
    needed = _KEYS_OF_WALK[group.walk.kind]
    for name in needed:
        if getattr(group.walk, name) in (None, ()):
            remedy = f"a walk of kind {group.walk.kind!r} needs {', '.join(needed)}"
            raise SceneError(source, f"{key}.{name}", "missing key", remedy)
    keys = (*needed, *_MORE_KEYS_OF_WALK.get(group.walk.kind, ()))
    for field in dataclasses.fields(group.walk):
        is_given = getattr(group.walk, field.name) != field.default
        if is_given and field.name not in ("kind", *keys):
            remedy = f"remove it: a walk of kind {group.walk.kind!r} has {', '.join(keys)}"
            raise SceneError(source, f"{key}.{field.name}", "would be ignored", remedy)
    if group.walk.road is not None:
        _known(source, f"{key}.road", [group.walk.road], roads)


def _known(source: str, key: str, names: Iterable[str], known: Iterable[str]) -> None:
    known = list(known)
    for name in names:
        if name not in known:
            raise SceneError(source, key, f"unknown name {name!r}", f"choose from {known}")


def check_places(layout: Layout, source: str) -> None:
    """Checks that zones, closures, crosswalks and walks are on their roads, none without length.

    Rows may extend beyond their road.

    Raises:
        SceneError: names the key and the remedy.
    """
    for key, road, places in _places(layout.scene):
        length = layout.lines[road].length
        if not all(0.0 <= at <= length + 1e-6 for at in places):
            there = " to ".join(f"{at:g}" for at in places)
            problem = f"{there} m is not on road {road!r}"
            raise SceneError(source, key, problem, f"stay within 0 and {length:.1f}")
        if len(places) == 2 and places[0] == places[1]:
            raise SceneError(source, key, "has no length", "give from_m and to_m that differ")


def _places(scene: Scene) -> Iterator[tuple[str, str, tuple[float, ...]]]:
    """Yields key, road, and distances along the road."""
    for zone in scene.zones:
        yield f"zones.{zone.name}", zone.road, (zone.from_m, zone.to_m)
    for closure in scene.closures:
        yield f"closures.{closure.name}.at_m", closure.road, (closure.at_m,)
    for i, crosswalk in enumerate(scene.crosswalks):
        yield f"crosswalks[{i}].at_m", crosswalk.road, (crosswalk.at_m,)
    for group in scene.pedestrian_groups:
        walk, key = group.walk, f"pedestrian_groups.{group.name}.walk"
        if walk.road is not None:
            given = (walk.at_m, walk.from_m, walk.to_m)
            yield key, walk.road, tuple(at for at in given if at is not None)


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


def check_walks(layout: Layout, source: str) -> None:
    """Checks that no draw of an episode lets anyone walk into a box or another person.

    Nor may it put anyone where the vehicle starts.

    Raises:
        SceneError: names the group and the remedy.
    """
    groups = layout.scene.pedestrian_groups
    grounds = [_ground(layout, group, source) for group in groups]
    boxes = [*layout.buildings, *layout.obstacles, *layout.closures.values()]
    tree = shapely.STRtree([box.footprint for box in boxes])
    for group, ground in zip(groups, grounds):
        near = tree.query(ground, predicate="dwithin", distance=RADIUS_M)[1]
        if near.size:
            box = boxes[near.min()]
            problem = f"goes through a {box.category} at ({box.x_m:.1f}, {box.y_m:.1f})"
            remedy = "move the walk or that box, or narrow spread_m"
            raise SceneError(source, f"{_key(group)}.walk", problem, remedy)
        _check_starts(layout, group, ground, source)
    for (one, ground), (other, other_ground) in combinations(zip(groups, grounds), 2):
        gap = gap_m(ground, other_ground)
        if gap < APART_M:
            problem = f"people of {other.name!r} come within {gap:.2f} m of those of this group"
            remedy = f"keep the walks {APART_M} m apart: move one of them, or narrow its spread_m"
            raise SceneError(source, _key(one), problem, remedy)


def _check_starts(
    layout: Layout, group: PedestrianGroup, ground: list[BaseGeometry], source: str
) -> None:
    for path in layout.scene.paths:
        if shapely.dwithin(ground, layout.start_footprint(path.start), RADIUS_M).any():
            problem = f"people can be where the vehicle starts path {path.name!r}"
            remedy = f"move the walk or zone {path.start!r}, or narrow spread_m"
            raise SceneError(source, f"{_key(group)}.walk", problem, remedy)


def _ground(layout: Layout, group: PedestrianGroup, source: str) -> list[BaseGeometry]:
    key = _key(group)
    spread, least = group.spread_m, least_spread_m(group.count)
    if spread < least:
        problem = f"is {spread}, but {group.count} people need lanes {least:.2f} m wide together"
        raise SceneError(source, f"{key}.spread_m", problem, f"give {least:.2f} or more")
    line = layout.walk_line(group.walk)
    if len(line) < 2:
        problem = "has no length"
        raise SceneError(source, f"{key}.walk", problem, "give two places apart from each other")
    is_walkable = all(keeps_its_stretches(line, side * spread / 2) for side in (-1, 1))
    if not is_walkable or (group.count > 1 and not keeps_lanes_apart(line, spread)):
        problem = f"comes too near to itself, or bends too sharply, for lanes {spread} m wide"
        remedy = "stretch or straighten the walk, or give fewer people and a smaller spread_m"
        raise SceneError(source, f"{key}.walk", problem, remedy)
    return covered_ground(line, spread)


def _key(group: PedestrianGroup) -> str:
    return f"pedestrian_groups.{group.name}"
