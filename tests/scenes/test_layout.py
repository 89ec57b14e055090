"""A scene's ground plan against places worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely

from flowrep.scenes import load_scene
from flowrep.scenes.layout import Layout, parallel
from flowrep.scenes.scene import BuildingRow, Crosswalk, ObstacleRow

CORNER = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0)])


def test_an_arc_ends_where_its_radius_says(data):
    layout = Layout(load_scene(data))
    # From (35, 0) along x, 90° to the left on 20 m: (55, 20), then 40 m along y.
    np.testing.assert_allclose(layout.lines["to_left"].coords[-1], (55.0, 60.0), atol=1e-9)
    np.testing.assert_allclose(layout.lines["to_right"].coords[-1], (55.0, -60.0), atol=1e-9)
    x, y, heading = layout.pose_at("to_left", 60.0, offset_m=2.0)
    assert heading == pytest.approx(math.pi / 2)
    assert x == pytest.approx(53.0)  # left of +y is -x
    assert y > 40
    # Roads that meet are one ground, which sidewalks leave free.
    assert layout.drivable.geom_type == "Polygon"
    assert layout.sidewalks.intersection(layout.drivable).area == pytest.approx(0.0, abs=1e-6)


def test_walks_go_across_and_along(data):
    layout = Layout(load_scene(data))
    along, across = (group.walk for group in layout.scene.pedestrian_groups)
    # Half the road and the sidewalk less a stride: 3.5 + 2 - 0.5 = 5; from right to left.
    np.testing.assert_allclose(layout.walk_line(across), [(25, -5), (25, 5)], atol=1e-9)
    # A metre to the left of someone who walks to the left is a metre back along the road.
    np.testing.assert_allclose(layout.walk_line(across, 1.0)[:, 0], 24.0, atol=1e-9)
    # 4.5 m to the left of the arc's centre line is the circle of radius 15.5 around (35, 20).
    points = layout.walk_line(along)
    bend = points[points[:, 1] < 19]
    np.testing.assert_allclose(np.hypot(bend[:, 0] - 35, bend[:, 1] - 20), 15.5, atol=0.05)


def test_corners_are_rounded_where_roads_meet(data):
    stem, east, north = data["roads"]
    roads = [
        stem,
        east | {"pieces": [{"straight_m": 40.0}]},
        north | {"heading_deg": 90.0, "pieces": [{"straight_m": 60.0}]},
    ]
    zones = [data["zones"][0], {"name": "east", "road": "to_left", "from_m": 30.0, "to_m": 38.0}]
    data |= {"roads": roads, "zones": zones, "pedestrian_groups": [], "obstacles": []}
    data |= {"paths": [{"name": "on", "start": "south", "end": "east"}], "closures": []}
    square, rounded = (
        Layout(load_scene(data | {"corner_radius_m": radius})).drivable for radius in (0.0, 4.0)
    )
    # The northern road's left edge x = 31.5 meets the eastern road's upper edge y = 3.5: the circle
    # of radius 4 that touches both has its centre at (27.5, 7.5) and leaves (1 - π/4)·4² of ground;
    # so it is on the other side.
    assert rounded.area - square.area == pytest.approx(2 * (1 - math.pi / 4) * 16, rel=0.02)
    assert rounded.contains(shapely.Point(31.0, 4.0))
    assert not rounded.contains(shapely.Point(28.0, 7.0))
    # Without sidewalks there are none at the corners either.
    data |= {"roads": [road | {"sidewalk_m": 0.0} for road in roads], "corner_radius_m": 4.0}
    assert Layout(load_scene(data)).sidewalks.is_empty


def test_rows_leave_out_obstacles_on_other_roads(data):
    row = {"kind": "car", "road": "stem", "offset_m": 4.0, "from_m": 2.0, "to_m": 60.0}
    row |= {"every_m": 10.0, "size_m": [4.0, 1.8, 1.5]}
    layout = Layout(load_scene(data | {"obstacle_rows": [row], "obstacles": []}))
    # At 2, 12, 22, 32, ...: the stem's 40 m and the arms that begin at 35 m leave the first four.
    np.testing.assert_allclose([box.x_m for box in layout.obstacles], [2, 12, 22, 32])
    assert {(box.kind, box.category, box.y_m) for box in layout.obstacles} == {("car", "car", 4.0)}
    # On the left of a road along x cars are parked against it, on the right along it.
    assert {box.yaw_rad for box in layout.obstacles} == {math.pi}
    right = Layout(load_scene(data | {"obstacle_rows": [row | {"offset_m": -4.0}]}))
    assert {box.yaw_rad for box in right.obstacles if box.y_m == -4.0} == {0.0}


def test_houses_keep_clear_of_roads_and_of_one_another():
    for name in ("s_turn", "h_shaped_pathways", "three_way_junction"):
        layout = Layout(load_scene(name))
        for i, house in enumerate(layout.buildings):
            ground = house.footprint.buffer(-0.06)
            assert not ground.intersects(layout.drivable)
            across = [row for row in layout.scene.building_rows if row.side in ("start", "end")]
            clashes = [o for o in layout.buildings[:i] if ground.intersects(o.footprint)]
            assert len(clashes) <= 2 * len(across)
        assert len(layout.buildings) > 20


def test_a_crosswalk_covers_its_stretch_of_road(data):
    data["categories"].append("crosswalk")
    crosswalk = {"road": "to_left", "at_m": 50.0, "depth_m": 3.0}
    (area,) = Layout(load_scene(data | {"crosswalks": [crosswalk]})).crosswalks
    assert area.polygon.area == pytest.approx(3.0 * 7.0)
    assert area.heading_rad == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(("at_m", "x0", "x1"), [(1.0, -25, -22), (214.0, 187, 190)])
def test_a_crosswalk_ends_where_its_road_does(straight_road, at_m, x0, x1):
    # 4 m deep, a metre from an end of the road from (-25, 0) to (190, 0).
    categories = (*straight_road.categories, "crosswalk")
    crosswalks = (Crosswalk("main", at_m, 4.0),)
    scene = replace(straight_road, categories=categories, crosswalks=crosswalks)
    assert Layout(load_scene(scene)).crosswalks[0].polygon.bounds == (x0, -3.5, x1, 3.5)


def test_rows_beyond_a_road_are_on_its_straight_continuation(straight_road):
    # The road goes from (-25, 0) to (190, 0); its side is 5 m from its middle.
    categories = (*straight_road.categories, "tree")
    trees = [
        ObstacleRow("tree", "main", 6.0, first, last, 10.0, (0.4, 0.4, 5.0))
        for first, last in ((-20.0, 0.0), (205.0, 230.0))
    ]
    rows = [
        BuildingRow("main", "right", first, last, 1.5, (10.0, 10.0), (6.0, 6.0), (5.0, 5.0))
        for first, last in ((-30.0, 0.0), (212.0, 230.0))
    ]
    scene = replace(
        straight_road, categories=categories, obstacle_rows=tuple(trees), building_rows=tuple(rows)
    )
    layout = Layout(load_scene(scene))
    np.testing.assert_allclose(
        [(box.x_m, box.y_m) for box in layout.obstacles],
        [(-45, 6), (-35, 6), (180, 6), (190, 6), (200, 6)],
    )
    # Wall to wall, each 10 m wide: from -55 to -25, and from 187 to 207.
    middles = [-50, -40, -30, 192, 202]
    np.testing.assert_allclose([house.x_m for house in layout.buildings], middles)
    # A row that ends with its road has no house beyond it.
    *rows, across = Layout(straight_road).buildings
    assert max(house.x_m for house in rows) < 190 < across.x_m


def test_a_line_moved_aside_is_parallel_stretch_by_stretch():
    # The left of +x is +y, of +y it is -x.
    np.testing.assert_allclose(parallel(CORNER, 1.0), [(0, 1), (3, 1), (3, 3)])
    np.testing.assert_allclose(parallel(CORNER, -1.0), [(0, -1), (5, -1), (5, 3)])
    np.testing.assert_array_equal(parallel(CORNER, 0.0), CORNER)
