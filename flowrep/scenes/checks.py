"""Checks of a scene as a whole: its parts agree, paths are open, people keep apart.

They run after pydantic has checked each part.
"""

import math
from collections.abc import Iterable, Iterator
from itertools import combinations
from typing import Any

import shapely

from flowrep.scenes import pedestrians
from flowrep.scenes.layout import Layout, centreline, free_ground
from flowrep.scenes.scene import (
    CATEGORY_ID,
    CATEGORY_OF_KIND,
    BuildingRow,
    ObstacleRow,
    Path,
    PedestrianGroup,
    Scene,
    SceneError,
    check_speed,
)

MOST_BOXES = 2_000
"""Most houses and obstacles of a scene: as many take some ten seconds to build."""
_LEAST_END_M = 1.0  # length of an end zone; the vehicle's position is tested at least every 0.42 m


def check_references(scene: Scene) -> None:
    """Checks that all names exist, and that distances along a road don't exceed its length."""
    most = 255 // len(pedestrians.PARTS)  # instance ids have 8 bits, and 0 is the static world
    if scene.num_pedestrians > most:
        raise SceneError(f"pedestrian_groups: {scene.num_pedestrians} people; give {most} or fewer")
    speeds_mps = {"vehicle.speed_mps": scene.vehicle.speed_mps}
    for mode, (_, highest) in scene.pedestrian_speed_mps.items():
        speeds_mps[f"pedestrian_speed_mps.{mode}"] = highest
    for group in scene.pedestrian_groups:
        speeds_mps[f"pedestrian_groups.{group.name}.speed_mps"] = (group.speed_mps or (0, 0))[1]
    for key, speed_mps in speeds_mps.items():
        check_speed(key, speed_mps, scene.camera, scene.frame_rate_hz)
    _check_known("categories", scene.categories, CATEGORY_ID)
    for key, names in _categories_used(scene).items():
        _check_known(key, names, scene.categories)
    lengths_m = {road.name: centreline(road).length for road in scene.roads}
    for key, item in _on_roads(scene):
        _check_known(f"{key}.road", [item.road], lengths_m)
        keys = (getattr(item, name, None) for name in ("at_m", "from_m", "to_m"))
        along_m = [at for at in keys if at is not None]
        length, may_extend = lengths_m[item.road], isinstance(item, BuildingRow | ObstacleRow)
        if not may_extend and not all(0.0 <= at <= length + 1e-6 for at in along_m):
            span = " to ".join(f"{at:g}" for at in along_m)
            raise SceneError(
                f"{key}: {span} m is not on road {item.road!r}; stay within 0 and {length:.1f}"
            )
    sidewalks_m = {road.name: road.sidewalk_m for road in scene.roads}
    for i, row in enumerate(scene.building_rows):
        if row.side in ("left", "right") and row.setback_m < (least_m := sidewalks_m[row.road]):
            raise SceneError(
                f"building_rows[{i}].setback_m: is {row.setback_m:g}, within the sidewalk of road "
                f"{row.road!r}, where no house may stand; give {least_m:g} or more"
            )
    spans = [(row.to_m - row.from_m) / row.front_m[0] for row in scene.building_rows]
    spans += [(row.to_m - row.from_m) / row.every_m for row in scene.obstacle_rows]
    if (boxes := math.ceil(sum(spans)) + len(scene.obstacles)) > MOST_BOXES:
        raise SceneError(
            f"building_rows and obstacle_rows: have room for {boxes:,} houses and obstacles, but a "
            f"scene has at most {MOST_BOXES:,}; give shorter rows or wider spaces"
        )
    ends = {path.end for path in scene.paths}
    for zone in scene.zones:
        if zone.name in ends and zone.to_m - zone.from_m < _LEAST_END_M - 1e-6:
            raise SceneError(
                f"zones.{zone.name}: vehicles can drive through this end of a path between checks; "
                f"make it {_LEAST_END_M:g} m long"
            )
    for path in scene.paths:
        key = f"paths.{path.name}"
        _check_known(key, [path.start, path.end], [zone.name for zone in scene.zones])
        _check_known(f"{key}.closures", path.closures, [each.name for each in scene.closures])


def _categories_used(scene: Scene) -> dict[str, list[str]]:
    return {
        "scene": ["sky", "road"],
        "obstacles": [CATEGORY_OF_KIND[o.kind] for o in scene.obstacles],
        "obstacle_rows": [CATEGORY_OF_KIND[row.kind] for row in scene.obstacle_rows],
        "crosswalks": ["crosswalk"] * bool(scene.crosswalks),
        "terrain_m": ["terrain"] * (scene.terrain_m > 0),
        "roads": ["sidewalk"] * any(road.sidewalk_m > 0 for road in scene.roads),
        "pedestrian_groups": ["pedestrian"] * bool(scene.pedestrian_groups),
        "building_rows or closures": ["building"] * bool(scene.building_rows or scene.closures),
    }


def _on_roads(scene: Scene) -> Iterator[tuple[str, Any]]:
    for part in ("zones", "closures", "crosswalks", "building_rows", "obstacle_rows"):
        for i, item in enumerate(getattr(scene, part)):
            yield f"{part}.{item.name}" if hasattr(item, "name") else f"{part}[{i}]", item
    for group in scene.pedestrian_groups:
        if group.walk.road is not None:
            yield f"pedestrian_groups.{group.name}.walk", group.walk


def _check_known(key: str, names: Iterable[str], known: Iterable[str]) -> None:
    for name in names:
        if name not in known:
            raise SceneError(f"{key}: unknown name {name!r}; choose from {list(known)}")


def check_path(layout: Layout, path: Path) -> None:
    """Checks that a path starts on free road and leads to its end zone."""
    key = f"paths.{path.name}"
    footprint, end = layout.start_footprint(path.start), layout.zones[path.end]
    blocks = [box.footprint for box in layout.boxes(path)]
    if not layout.drivable.covers(footprint):
        raise SceneError(f"{key}: starts off the road; move or widen its start zone")
    if shapely.intersects(footprint, blocks).any():
        raise SceneError(f"{key}: its start is blocked by a box; move one of them")
    if shapely.intersects(end, blocks).any():
        raise SceneError(f"{key}: its end zone is blocked by a box; move one of them")
    start, vehicle = shapely.Point(layout.start_state(path.start)[:2]), layout.scene.vehicle
    if end.intersects(start):
        raise SceneError(f"{key}: starts inside its end zone {path.end!r}; move one of them")
    # Start and end must lie in one connected piece of the ground that is at least half of the
    # vehicle's narrower side away from everything else.
    room = free_ground(layout, path).buffer(-min(vehicle.width_m, vehicle.length_m) / 2)
    if not any(part.covers(start) and part.intersects(end) for part in shapely.get_parts(room)):
        raise SceneError(
            f"{key}: no free road leads from {path.start!r} to {path.end!r}; join the roads or "
            "open a closure"
        )


def check_walks(layout: Layout) -> None:
    """Checks that people never overlap a box, another person or the start of the vehicle."""
    size = layout.scene.largest_size
    reach, least = size * pedestrians.RADIUS_M, size * pedestrians.APART_M
    grounds = {group.name: _ground(layout, group) for group in layout.scene.pedestrian_groups}
    boxes = [*layout.buildings, *layout.obstacles, *layout.closures.values()]
    tree = shapely.STRtree([box.footprint for box in boxes])
    for name, ground in grounds.items():
        key = f"pedestrian_groups.{name}.walk"
        near = tree.query(ground, predicate="dwithin", distance=reach)[1]
        if near.size:
            box = boxes[near.min()]
            raise SceneError(
                f"{key}: goes through a {box.category} at ({box.x_m:.1f}, {box.y_m:.1f}); move the "
                "walk or that box, or narrow spread_m"
            )
        for path in layout.scene.paths:
            if shapely.dwithin(ground, layout.start_footprint(path.start), reach).any():
                raise SceneError(
                    f"{key}: people can be where the vehicle starts path {path.name!r}; move the "
                    f"walk or zone {path.start!r}, or narrow spread_m"
                )
    wholes = {name: shapely.geometrycollections(ground) for name, ground in grounds.items()}
    for (one, ground), (other, other_ground) in combinations(wholes.items(), 2):
        if (gap := ground.distance(other_ground)) < least:
            raise SceneError(
                f"pedestrian_groups.{one}: people of {other!r} come within {gap:.2f} m of those of "
                f"this group; keep the walks {least:g} m apart: move one, or narrow its spread_m"
            )


def _ground(layout: Layout, group: PedestrianGroup) -> list[shapely.Geometry]:
    key, spread = f"pedestrian_groups.{group.name}", group.spread_m
    size = layout.scene.largest_size
    if spread < (least := pedestrians.least_spread_m(group.count, size)):
        raise SceneError(
            f"{key}.spread_m: is {spread}, but {group.count} people need lanes {least:.2f} m wide "
            f"together; give {least:.2f} or more"
        )
    line = layout.walk_line(group.walk)
    if len(line) < 2:
        raise SceneError(f"{key}.walk: has no length; give two points apart from each other")
    # Only the walk of a single person may cross itself; where lanes cross, two people could meet.
    is_walkable = all(pedestrians.keeps_its_stretches(line, side * spread / 2) for side in (-1, 1))
    if group.count > 1:
        is_walkable = is_walkable and pedestrians.keeps_lanes_apart(line, spread, size)
    if not is_walkable:
        raise SceneError(
            f"{key}.walk: comes too near to itself, or bends too sharply, for lanes {spread} m "
            "wide; stretch or straighten the walk, or give fewer people and a smaller spread_m"
        )
    return pedestrians.covered_ground(line, spread)
