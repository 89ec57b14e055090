"""Checks that people can walk their walks without meeting boxes or each other."""

from itertools import combinations

import shapely
from shapely.geometry.base import BaseGeometry

from flowrep.scenes.layout import Layout
from flowrep.scenes.people import RADIUS_M
from flowrep.scenes.scene import PedestrianGroup
from flowrep.scenes.schema import SceneError
from flowrep.scenes.walks import (
    APART_M,
    covered_ground,
    gap_m,
    keeps_its_stretches,
    keeps_lanes_apart,
    least_spread_m,
)


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
