"""Checks that the parts of a scene agree: references resolve and keys fit together."""

import dataclasses
from collections import Counter
from collections.abc import Iterable

from flowrep.palette import CATEGORY_ID
from flowrep.scenes.people import PARTS
from flowrep.scenes.scene import (
    CATEGORY_OF_KIND,
    LEAST_HEIGHT_M,
    BuildingRow,
    Obstacle,
    ObstacleRow,
    PedestrianGroup,
    Piece,
    Scene,
)
from flowrep.scenes.schema import SceneError

_KEYS_OF_WALK = {
    "across": ("road", "at_m"),
    "along": ("road", "from_m", "to_m"),
    "points": ("points_m",),
}
_MORE_KEYS_OF_WALK = {"along": ("offset_m",)}


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
