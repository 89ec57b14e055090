"""Reads a scene from its name, a YAML file or plain data, and refuses one that cannot be."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import shapely
import yaml
from shapely.geometry import Point, Polygon

from flowrep.config_tree import CONF_DIR
from flowrep.envs.layout import Layout, centrelines
from flowrep.envs.people import PARTS
from flowrep.envs.scene import CATEGORY_OF_KIND, Piece, Scene
from flowrep.envs.scene import Path as ScenePath
from flowrep.envs.schema import SceneError, build
from flowrep.envs.vehicle import footprint_corners
from flowrep.envs.walk_checks import check_walks
from flowrep.envs.way import free_ground
from flowrep.palette import CATEGORY_ID


def load_scene(scene: str | Path | Mapping[str, Any] | Scene) -> Scene:
    """Returns a checked scene.

    Args:
        scene: the name of a file in `conf/scene`, the path of a YAML file, a mapping of its keys,
            or a `Scene`, which is checked again.

    Raises:
        SceneError: names the file, the key, what was expected and what to do.

    >>> load_scene("straight_road").time_limit_steps
    200
    """
    if isinstance(scene, Scene):
        loaded, source = scene, f"scene {scene.name!r}"
    elif isinstance(scene, Mapping):
        source = f"scene {scene.get('name', 'without a name')!r}"
        loaded = build(Scene, scene, source=source)
    else:
        path = _find(scene)
        source = str(path)
        loaded = build(Scene, _read(path), source=source)
    _check_values(loaded, source)
    _check_names(loaded, source)
    _check_ground(loaded, source)
    return loaded


def scene_names() -> list[str]:
    """Returns the names of the scenes in `conf/scene`."""
    return sorted(path.stem for path in (CONF_DIR / "scene").glob("*.yaml"))


def _find(scene: str | Path) -> Path:
    path = Path(scene)
    if path.suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise SceneError(str(path), "", "there is no such file", "give an existing YAML file")
        return path
    if str(scene) not in scene_names():
        known = ", ".join(scene_names())
        raise SceneError(
            f"scene {str(scene)!r}", "", "unknown name", f"choose one of {known}, or give a file"
        )
    return CONF_DIR / "scene" / f"{scene}.yaml"


def _read(path: Path) -> Any:
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        problem = " ".join(str(error).split())
        raise SceneError(str(path), "", f"not YAML: {problem}", "mend the file") from error


def _check_values(scene: Scene, source: str) -> None:
    positive = {
        "frame_rate_hz": scene.frame_rate_hz,
        "time_limit_steps": scene.time_limit_steps,
        **{f"camera.{k}": getattr(scene.camera, k) for k in ("height_px", "width_px", "near_m")},
        **{f"vehicle.{k}": v for k, v in vars(scene.vehicle).items()},
        **{f"roads.{road.name}.width_m": road.width_m for road in scene.roads},
        **{f"pedestrian_groups.{g.name}.count": g.count for g in scene.pedestrian_groups},
        **{f"obstacles[{i}].size_m": min(o.size_m) for i, o in enumerate(scene.obstacles)},
        **{
            f"obstacle_rows[{i}].{key}": value
            for i, row in enumerate(scene.obstacle_rows)
            for key, value in (("size_m", min(row.size_m)), ("every_m", row.every_m))
        },
        **{f"crosswalks[{i}].depth_m": c.depth_m for i, c in enumerate(scene.crosswalks)},
    }
    for key, value in positive.items():
        if value <= 0:
            raise SceneError(source, key, f"is {value}", "give a number above 0")
    if not 0 < scene.camera.fov_deg < 180:
        raise SceneError(source, "camera.fov_deg", f"is {scene.camera.fov_deg}", "stay in (0, 180)")
    if scene.camera.far_m <= scene.camera.near_m:
        raise SceneError(source, "camera.far_m", "is not beyond near_m", "give a larger far_m")
    for key in ("terrain_m", "corner_radius_m"):
        if getattr(scene, key) < 0:
            raise SceneError(source, key, f"is {getattr(scene, key)}", "give 0 or more")
    if len(PARTS) * scene.num_pedestrians > 255:
        problem = (
            f"{scene.num_pedestrians} people, but their {len(PARTS)} parts each have 8-bit ids"
        )
        raise SceneError(source, "pedestrian_groups", problem, f"keep to {255 // len(PARTS)}")
    ranges: dict[str, Any] = {
        f"pedestrian_speed_mps.{k}": v for k, v in scene.pedestrian_speed_mps.items()
    } | {f"pedestrian_groups.{g.name}.speed_mps": g.speed_mps for g in scene.pedestrian_groups}
    for key, bounds in ranges.items():
        if bounds is not None and not 0 <= bounds[0] <= bounds[1]:
            raise SceneError(source, key, f"is {list(bounds)}", "give [lowest, highest], from 0")
    for group in scene.pedestrian_groups:
        if not 0 <= group.standing <= group.count:
            key = f"pedestrian_groups.{group.name}.standing"
            raise SceneError(source, key, f"is {group.standing}", f"stay in 0..{group.count}")
    for road in scene.roads:
        for i, piece in enumerate(road.pieces):
            _check_piece(piece, source, f"roads.{road.name}.pieces[{i}]")


def _check_piece(piece: Piece, source: str, key: str) -> None:
    arc = (piece.arc_radius_m, piece.arc_deg)
    is_straight = piece.straight_m is not None and arc == (None, None)
    is_arc = piece.straight_m is None and None not in arc
    if not (is_straight or is_arc):
        remedy = "give straight_m alone, or arc_radius_m and arc_deg"
        raise SceneError(source, key, "neither a straight piece nor an arc", remedy)
    if (piece.straight_m or piece.arc_radius_m or 0.0) <= 0 or piece.arc_deg == 0:
        raise SceneError(source, key, "has no length", "give lengths above 0 and a turn")


def _check_names(scene: Scene, source: str) -> None:
    _known(source, "categories", scene.categories, CATEGORY_ID)
    used = {
        "scene": ["sky", "road"],
        "obstacles": [CATEGORY_OF_KIND[o.kind] for o in scene.obstacles],
        "obstacle_rows": [CATEGORY_OF_KIND[row.kind] for row in scene.obstacle_rows],
        "crosswalks": ["crosswalk"] * bool(scene.crosswalks),
        "terrain_m": ["terrain"] * (scene.terrain_m > 0),
    }
    if any(road.sidewalk_m > 0 for road in scene.roads):
        used["roads"] = ["sidewalk"]
    if scene.pedestrian_groups:
        used["pedestrian_groups"] = ["pedestrian"]
    if scene.building_rows or scene.closures:
        used["building_rows or closures"] = ["building"]
    for key, names in used.items():
        _known(source, key, names, scene.categories)
    for part in ("roads", "zones", "paths", "pedestrian_groups", "closures"):
        names = [item.name for item in getattr(scene, part)]
        for name in names:
            if names.count(name) > 1:
                raise SceneError(source, part, f"two are named {name!r}", "rename one of them")
    if not scene.paths:
        raise SceneError(source, "paths", "is empty", "name a start zone and an ending zone")
    roads = [road.name for road in scene.roads]
    zones = [zone.name for zone in scene.zones]
    for zone in scene.zones:
        _known(source, f"zones.{zone.name}.road", [zone.road], roads)
    for path in scene.paths:
        _known(source, f"paths.{path.name}", [path.start, path.end], zones)
        closures = [closure.name for closure in scene.closures]
        _known(source, f"paths.{path.name}.closures", path.closures, closures)
    for key in ("building_rows", "obstacle_rows", "closures", "crosswalks"):
        _known(source, f"{key}.road", [item.road for item in getattr(scene, key)], roads)
    for group in scene.pedestrian_groups:
        key = f"pedestrian_groups.{group.name}.walk"
        needed = {
            "across": ("road", "at_m"),
            "along": ("road", "from_m", "to_m"),
            "points": ("points_m",),
        }[group.walk.kind]
        for name in needed:
            if getattr(group.walk, name) in (None, ()):
                remedy = f"a walk of kind {group.walk.kind!r} needs {', '.join(needed)}"
                raise SceneError(source, f"{key}.{name}", "missing key", remedy)
        if group.walk.road is not None:
            _known(source, f"{key}.road", [group.walk.road], roads)


def _known(source: str, key: str, names: Iterable[str], known: Iterable[str]) -> None:
    known = list(known)
    for name in names:
        if name not in known:
            raise SceneError(source, key, f"unknown name {name!r}", f"choose from {known}")


def _check_ground(scene: Scene, source: str) -> None:
    lengths = {road: line.length for road, line in centrelines(scene).items()}
    for zone in scene.zones:
        if not 0 <= zone.from_m < zone.to_m <= lengths[zone.road] + 1e-6:
            problem = f"[{zone.from_m}, {zone.to_m}] m is not on road {zone.road!r}"
            remedy = f"stay within 0 and {lengths[zone.road]:.1f}, from_m below to_m"
            raise SceneError(source, f"zones.{zone.name}", problem, remedy)
    for i, crosswalk in enumerate(scene.crosswalks):
        if not 0 <= crosswalk.at_m <= lengths[crosswalk.road]:
            problem = f"{crosswalk.at_m} m is not on road {crosswalk.road!r}"
            remedy = f"stay within 0 and {lengths[crosswalk.road]:.1f}"
            raise SceneError(source, f"crosswalks[{i}].at_m", problem, remedy)
    layout = Layout(scene)
    _check_paths(layout, source)
    check_walks(layout, source)


def _check_paths(layout: Layout, source: str) -> None:
    solid = [*layout.buildings, *layout.obstacles]
    for path in layout.scene.paths:
        key = f"paths.{path.name}"
        blocks = [*solid, *(layout.closures[name] for name in path.closures)]
        footprint = Polygon(footprint_corners(layout.start_state(path.start), layout.scene.vehicle))
        if not layout.drivable.covers(footprint):
            raise SceneError(source, key, "starts off the road", "move or widen its start zone")
        if any(box.footprint.intersects(footprint) for box in blocks):
            raise SceneError(source, key, "its start collides", "move the start or what is in it")
        if any(box.footprint.intersects(layout.zones[path.end]) for box in blocks):
            raise SceneError(source, key, "its ending zone is built over", "move what is in it")
        if not _is_open(layout, path):
            problem = f"no free road leads from {path.start!r} to {path.end!r}"
            raise SceneError(source, key, problem, "join the roads or open a closure")


def _is_open(layout: Layout, path: ScenePath) -> bool:
    # Some ground that the vehicle's narrower side fits on holds both the start and the end.
    vehicle = layout.scene.vehicle
    room = free_ground(layout, path).buffer(-min(vehicle.width_m, vehicle.length_m) / 2)
    start = Point(layout.start_state(path.start)[:2])
    parts = shapely.get_parts(room)
    return any(part.covers(start) and part.intersects(layout.zones[path.end]) for part in parts)
