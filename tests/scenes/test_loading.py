"""Scenes from data: what is read, and what is refused with file, key and remedy."""

import copy
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
import yaml

from flowrep.baselines import Planner, drives
from flowrep.scenes import SceneError, load_scene
from flowrep.scenes.layout import Layout
from flowrep.scenes.scene import BuildingRow, Crosswalk, ObstacleRow

CROSSROADS = Path(__file__).parent / "crossroads.yaml"
CATEGORIES = ["sky", "road", "sidewalk", "building", "pedestrian", "car"]


@pytest.fixture
def data():
    return yaml.safe_load(CROSSROADS.read_text())


def test_name_file_mapping_and_scene_give_the_same_scene(data):
    scene = load_scene(CROSSROADS)
    assert scene == load_scene(str(CROSSROADS)) == load_scene(data) == load_scene(scene)
    assert load_scene("straight_road").name == "straight_road"
    assert scene.num_pedestrians == 5
    assert scene.time_limit_s == pytest.approx(12.5)


def test_an_arc_ends_where_its_radius_says(data):
    layout = Layout(load_scene(data))
    # From (35, 0) along x, 90° to the left on 20 m: (55, 20), then 40 m along y.
    np.testing.assert_allclose(layout.lines["to_left"].coords[-1], (55.0, 60.0), atol=1e-9)
    np.testing.assert_allclose(layout.lines["to_right"].coords[-1], (55.0, -60.0), atol=1e-9)
    x, y, heading = layout.pose_at("to_left", 60.0, offset_m=2.0)
    assert heading == pytest.approx(math.pi / 2)
    assert x == pytest.approx(53.0)  # left of +y is -x
    assert y > 40


def test_roads_that_meet_are_one_ground_and_sidewalks_leave_it_free(data):
    layout = Layout(load_scene(data))
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


def test_each_path_is_drawn_and_the_others_arm_is_closed(make_street):
    env = make_street(CROSSROADS, sensors=("semantic",))
    drawn = []
    for _ in range(40):
        _, info = env.reset(seed=0 if not drawn else None)
        drawn.append(info["path"])
    assert 10 <= drawn.count("left") <= 30
    # Seen from the fork's mouth, the closed arm shows a house and the open one does not.
    house, halves = 3, {}
    for path in ("left", "right"):
        env.reset(options={"path": path, "episode_seed": 1})
        for _ in range(30):
            observation = env.step(0)[0]
        middle = observation["semantic"][0, 10:20]
        halves[path] = [(middle[:, part] == house).mean() for part in (slice(30), slice(30, 60))]
    assert halves["left"][0] < 0.05 < halves["left"][1]
    assert halves["right"][1] < 0.05 < halves["right"][0]


def test_a_closure_is_hit_where_it_stands(make_street):
    env = make_street(CROSSROADS, sensors=())
    # Someone who plans for the left arm and drives it while it is closed.
    env.reset(seed=0, options={"path": "left", "episode_seed": 3})
    actions = Planner().search(env.episode)
    env.reset(options={"path": "right", "episode_seed": 3})
    for action in actions:
        _, _, ended, _, info = env.step(action)
        if ended:
            break
    assert (info["outcome"], info["hit"]) == ("collision", "building")


def test_the_planner_drives_a_scene_it_was_not_made_for(make_street):
    env = make_street(CROSSROADS, sensors=())
    outcomes = [drive.outcome for drive in drives(env, Planner(), 6, seed=0)]
    assert outcomes.count("success") >= 5


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


def test_rows_leave_out_what_would_stand_in_the_way(data):
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
        straight_road,
        categories=categories,
        obstacle_rows=tuple(trees),
        building_rows=tuple(rows),
    )
    layout = Layout(load_scene(scene))
    np.testing.assert_allclose(
        [(box.x_m, box.y_m) for box in layout.obstacles],
        [(-45, 6), (-35, 6), (180, 6), (190, 6), (200, 6)],
    )
    # Wall to wall, each 10 m wide: from -55 to -25, and from 187 to 207.
    middles = [-50, -40, -30, 192, 202]
    np.testing.assert_allclose([house.x_m for house in layout.buildings], middles)


def test_a_row_that_ends_with_its_road_has_no_house_beyond_it(straight_road):
    *rows, across = Layout(straight_road).buildings
    assert max(house.x_m for house in rows) < 190 < across.x_m


def test_a_house_on_the_road_blocks_it(data):
    # A lane from the south ends 8 m below the stem's axis; the house beyond its end is built from
    # there over the stem, 6 m wide and 12 m deep.
    lane = {"name": "lane", "start_m": [20.0, -30.0], "heading_deg": 90.0, "width_m": 6.0}
    lane |= {"sidewalk_m": 0.0, "pieces": [{"straight_m": 22.0}]}
    house = {"road": "lane", "side": "end", "from_m": 0.0, "to_m": 0.0, "setback_m": 0.0}
    house |= {"front_m": [6.0, 6.0], "depth_m": [12.0, 12.0], "height_m": [8.0, 8.0]}
    data |= {"pedestrian_groups": [], "obstacles": [], "roads": [*data["roads"], lane]}
    load_scene(data)
    message = refuse(data, building_rows=[house])
    assert message.startswith("paths.left: no free road leads from 'south' to 'west'")


def test_rounded_roads_without_sidewalks_have_none(data):
    data |= {"roads": [road | {"sidewalk_m": 0.0} for road in data["roads"]]}
    data |= {"pedestrian_groups": [], "corner_radius_m": 5.0}
    assert Layout(load_scene(data)).sidewalks.is_empty


def refuse(data, **changes):
    """Returns the message that refuses the data with a change at each dotted key."""
    data = copy.deepcopy(data)
    for key, value in changes.items():
        *parents, last = [int(k) if k.isdigit() else k for k in key.split("__")]
        at = data
        for parent in parents:
            at = at[parent]
        if value is KeyError:
            del at[last]
        else:
            at[last] = value
    with pytest.raises(SceneError) as caught:
        load_scene(data)
    message = str(caught.value)
    assert message.startswith("scene 'crossroads': ")
    assert "\n" not in message
    return message.removeprefix("scene 'crossroads': ")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"camera__fov": 90},
            "camera.fov: unknown key; the keys are: height_px, width_px, fov_deg",
        ),
        ({"vehicle__speed_mps": KeyError}, "vehicle.speed_mps: missing key; add it"),
        ({"vehicle__speed_mps": "fast"}, "vehicle.speed_mps: got 'fast'; it should be a number"),
        ({"time_limit_steps": 1.5}, "time_limit_steps: got 1.5; it should be a whole number"),
        ({"time_limit_steps": True}, "time_limit_steps: got True; it should be a whole number"),
        ({"camera": 3}, "camera: got 3; it should be a mapping: write its keys"),
        ({"roads__0__start_m": [1.0]}, "roads[0].start_m[1]: missing value; add it"),
        ({"roads": "stem"}, "roads: got 'stem'; it should be a list"),
        (
            {"pedestrian_groups__0__draw": "each"},
            "pedestrian_groups[0].draw: got 'each'; it should be 'group' or 'pedestrian'",
        ),
        (
            {"pedestrian_speed_mps__low": KeyError},
            "pedestrian_speed_mps: got {'normal': [1.2, 1.8], 'high': [2.0, 2.4]}; give all",
        ),
        ({"pedestrian_speed_mps": 2}, "pedestrian_speed_mps: got 2; it should be a mapping"),
        (
            {"pedestrian_speed_mps__low": [2, 1]},
            "pedestrian_speed_mps.low: got [2, 1]; give",
        ),
        ({"frame_rate_hz": 0}, "frame_rate_hz: got 0; it should be at least 0.5"),
        ({"camera__fov_deg": 180}, "camera.fov_deg: got 180; it should be at most 179"),
        ({"camera__far_m": 0.1}, "camera.far_m: is not beyond near_m; give a larger far_m"),
        (
            {"pedestrian_groups__0__count": 84},
            "pedestrian_groups: 86 people, but their 3 parts each have 8-bit ids; keep to 85",
        ),
        (
            {"pedestrian_groups__0__standing": 4},
            "pedestrian_groups.along.standing: is 4; stay in 0",
        ),
        ({"roads__0__pieces__0": {}}, "roads.stem.pieces[0]: neither a straight piece nor an arc"),
        (
            {"roads__0__pieces__0": {"straight_m": -1}},
            "roads[0].pieces[0].straight_m: got -1; it should",
        ),
        ({"categories__0": "heaven"}, "categories: unknown name 'heaven'; choose from ['sky', "),
        (
            {"categories": ["sky", "road"]},
            "obstacles: unknown name 'car'; choose from ['sky', 'road",
        ),
        ({"zones__1__name": "south"}, "zones: two are named 'south'; rename one of them"),
        ({"paths": []}, "paths: got []; it should have at least 1 item, not 0"),
        (
            {"zones__0__road": "stam"},
            "zones.south.road: unknown name 'stam'; choose from ['stem', ",
        ),
        ({"paths__0__end": "north"}, "paths.left: unknown name 'north'; choose from ['south', "),
        ({"paths__0__closures": ["up"]}, "paths.left.closures: unknown name 'up'; choose from"),
        ({"closures__0__road": "up"}, "closures[0].road: unknown name 'up'; choose from ['stem', "),
        (
            {"pedestrian_groups__1__walk__at_m": KeyError},
            "pedestrian_groups.across.walk.at_m: missing key; a walk of kind 'across' needs road",
        ),
        (
            {"pedestrian_groups__1__walk__offset_m": 30.0},
            "pedestrian_groups.across.walk.offset_m: would be ignored; remove it: a walk of kind "
            "'across' has road, at_m",
        ),
        (
            {"pedestrian_groups__1__walk__from_m": 3.0},
            "pedestrian_groups.across.walk.from_m: would",
        ),
        (
            {"pedestrian_groups__1__walk__points_m": [[0.0, 0.0]]},
            "pedestrian_groups.across.walk.points_m: would be ignored; remove it",
        ),
        (
            {"pedestrian_groups__0__walk__at_m": 9.0},
            "pedestrian_groups.along.walk.at_m: would be ignored; remove it: a walk of kind "
            "'along' has road, from_m, to_m, offset_m",
        ),
        (
            {
                "pedestrian_groups__1__walk": {
                    "kind": "points",
                    "road": "stem",
                    "points_m": [[25.0, -5.0], [25.0, 5.0]],
                }
            },
            "pedestrian_groups.across.walk.road: would be ignored; remove it",
        ),
        ({"pedestrian_groups__1__walk__road": "up"}, "pedestrian_groups.across.walk.road: unknown"),
        (
            {"zones__1__to_m": 99.0},
            "zones.west: 60 to 99 m is not on road 'to_left'; stay within 0 and 71.4",
        ),
        (
            {"vehicle__width_m": 9.0},
            "paths.left: starts off the road; move or widen its start zone",
        ),
        ({"obstacles__0__center_m": [3.0, 0.0]}, "paths.left: its start collides; move the start"),
        (
            {"closures__1__at_m": 65.0, "paths__1__closures": ["right_arm"]},
            "paths.right: its ending",
        ),
        (
            {"obstacles__0__center_m": [25.0, 0.0]},
            "pedestrian_groups.across.walk: goes through a car",
        ),
        (
            {"pedestrian_groups__0__walk__to_m": 60.0},
            "pedestrian_groups.along.walk: goes through a building at",
        ),
        (
            {"paths__0__closures": ["left_arm"]},
            "paths.left: no free road leads from 'south' to 'west'; join the roads or open",
        ),
        ({"paths__0__end": "south"}, "paths.left: starts inside its ending zone 'south'; let it"),
        (  # it starts at 3 m, in the middle of south, and would end from 2 m on
            {"zones__1": {"name": "west", "road": "stem", "from_m": 2.0, "to_m": 9.0}},
            "paths.left: starts inside its ending zone 'west'; let it start or end elsewhere",
        ),
        (  # lanes begin at 3.7 m, people reach 0.3 m to either side, and the vehicle to 3.5 m
            {"pedestrian_groups__1__walk__at_m": 4.2},
            "pedestrian_groups.across.walk: people can be where the vehicle starts path 'left'; "
            "move the walk or zone 'south', or narrow spread_m",
        ),
        (  # 0.2 m beside the walk: a person is 0.3 m to either side
            {"obstacles__0__center_m": [22.8, 2.0], "obstacles__0__yaw_deg": 0.0},
            "pedestrian_groups.across.walk: goes through a car at (22.8, 2.0)",
        ),
        ({"obstacles__0__kind": "lorry"}, "obstacles[0].kind: got 'lorry'; it should be 'house',"),
        (
            {"obstacles__0__size_m": [4, 0, 1]},
            "obstacles[0].size_m[1]: got 0; it should be at",
        ),
        (
            {"obstacles__0__size_m": [4.0, 1.8, 0.6]},
            "obstacles[0].size_m[2]: is 0.6, too low for a car; give 0.7 or more",
        ),
        ({"terrain_m": 9.0}, "terrain_m: unknown name 'terrain'; choose from ['sky', "),
        ({"terrain_m": -1.0}, "terrain_m: got -1.0; it should be at least 0"),
        ({"corner_radius_m": -1.0}, "corner_radius_m: got -1.0; it should be at least 0"),
        (
            {"crosswalks": [{"road": "stem", "at_m": 20.0, "depth_m": 3.0}]},
            "crosswalks: unknown name 'crosswalk'; choose from ['sky', ",
        ),
        (
            {
                "crosswalks": [{"road": "stem", "at_m": 50.0, "depth_m": 3.0}],
                "categories": [
                    "sky",
                    "road",
                    "sidewalk",
                    "building",
                    "pedestrian",
                    "car",
                    "crosswalk",
                ],
            },
            "crosswalks[0].at_m: 50 m is not on road 'stem'; stay within 0 and 40.0",
        ),
        (
            {"zones__1__from_m": 69.5},
            "zones.west: ends a path and is 0.5 m long; give it 1 m, or vehicles can drive",
        ),
    ],
)
def test_what_cannot_be_is_refused(data, changes, expected):
    assert refuse(data, **changes).startswith(expected)


def test_an_ending_zone_may_be_a_metre_long(data):
    data["zones"][1] |= {"from_m": 63.1, "to_m": 64.1}  # 0.99999... in floating point
    load_scene(data)


def test_files_that_cannot_be_read_are_named(tmp_path):
    with pytest.raises(SceneError, match=r"scene 'straight': .*choose one of .*straight_road"):
        load_scene("straight")
    missing = tmp_path / "none.yaml"
    with pytest.raises(SceneError, match=r"none.yaml: .*no such file"):
        load_scene(missing)
    broken = tmp_path / "broken.yaml"
    broken.write_text("name: [1\n")
    with pytest.raises(SceneError, match=r"broken.yaml: .*is not YAML"):
        load_scene(broken)
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(CROSSROADS.read_text().replace("layout_seed: 3", "layout_sed: 3"))
    with pytest.raises(SceneError, match=r"wrong.yaml: layout_sed: unknown key"):
        load_scene(wrong)
