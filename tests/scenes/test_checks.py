"""What can't be a scene is refused on one line that names the key."""

from functools import reduce
from operator import getitem

import pytest

from flowrep.scenes import SceneError, load_scene

MISSING = object()
ALL = ["sky", "road", "sidewalk", "building", "pedestrian", "car", "crosswalk"]
CROSSWALK = {"road": "stem", "at_m": 20.0, "depth_m": 3.0}
BUILDING_ROW = {"road": "stem", "side": "left", "from_m": 0.0, "to_m": 40.0, "setback_m": 2.0}
BUILDING_ROW |= {"front_m": [7, 9], "depth_m": [6, 9], "height_m": [5, 9]}
OBSTACLE_ROW = {"road": "stem", "kind": "house", "offset_m": 8.0, "from_m": 0.0, "to_m": 40.0}
OBSTACLE_ROW |= {"every_m": 9.0, "size_m": [1.0, 1.0, 1.0]}
POINTS = {"kind": "points", "road": "stem", "points_m": [[25.0, -5.0], [25.0, 5.0]]}
ACROSS = {"kind": "across", "road": "stem", "at_m": 25.0}
ON_STEM = {"name": "west", "road": "stem", "from_m": 2.0, "to_m": 9.0}
CAR_BESIDE = {"kind": "car", "center_m": [22.8, 2.0], "yaw_deg": 0.0, "size_m": [4.0, 1.8, 1.5]}


def through(*points_m):
    return {"kind": "points", "points_m": [[float(x), float(y)] for x, y in points_m]}


def refusal(data, changes):
    """Returns the message that refuses the data with a value at each dotted key."""
    for key, value in changes.items():
        *parents, last = [int(part) if part.isdigit() else part for part in key.split(".")]
        at = reduce(getitem, parents, data)
        if value is MISSING:
            del at[last]
        else:
            at[last] = value
    with pytest.raises(SceneError) as caught:
        load_scene(data)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"scene {data['name']!r}: ")
    return message.removeprefix(f"scene {data['name']!r}: ")


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        # Types and ranges: numbers in quotes, true for 1 and numbers that aren't finite are none.
        ({"camera.fov": 90}, "camera.fov"),
        ({"vehicle.speed_mps": MISSING}, "vehicle.speed_mps"),
        ({"vehicle.speed_mps": "10"}, "vehicle.speed_mps"),
        ({"vehicle.speed_mps": float("inf")}, "vehicle.speed_mps"),
        ({"time_limit_steps": True}, "time_limit_steps"),
        ({"name": "../../up"}, "name"),
        ({"roads.0.start_m": [1.0]}, "roads[0].start_m[1]"),
        ({"paths": []}, "paths"),
        ({"roads.0.pieces": [{"straight_m": 0.01}] * 1_001}, "roads[0].pieces"),
        ({"zones": [ON_STEM | {"name": str(i)} for i in range(20_000)]}, "zones"),
        ({"pedestrian_groups.0.speed_mps": [2, 1]}, "pedestrian_groups[0].speed_mps"),
        ({"pedestrian_speed_mps.low": MISSING}, "pedestrian_speed_mps"),
        # Parts that don't agree with themselves.
        ({"camera.far_m": 0.1}, "camera"),
        ({"pedestrian_groups.0.standing": 4}, "pedestrian_groups[0]"),
        ({"roads.0.pieces.0": {}}, "roads[0].pieces[0]"),
        ({"roads.1.pieces.0.straight_m": 3.0}, "roads[1].pieces[0]"),
        ({"roads.1.pieces.0.arc_deg": 0.0}, "roads[1].pieces[0]"),
        ({"zones.0.from_m": 5.5}, "zones[0]"),
        ({"building_rows": [BUILDING_ROW | {"to_m": -9}]}, "building_rows[0]"),
        ({"building_rows": [BUILDING_ROW | {"side": "end"}]}, "building_rows[0]"),
        ({"building_rows": [BUILDING_ROW | {"from_m": -1e10}]}, "building_rows[0].from_m"),
        # Steps of a twelfth of a second past the 200 m that are seen.
        ({"vehicle.speed_mps": 1e7}, "vehicle.speed_mps"),
        ({"pedestrian_speed_mps.high": [2.0, 1e8]}, "pedestrian_speed_mps.high"),
        # Rows of which nothing would be placed, or too much: the sidewalk is 2 m wide, and a house
        # at least 7 m; the arms take the ground beside the last 5 m of the stem.
        ({"building_rows": [BUILDING_ROW | {"setback_m": 1.9}]}, "building_rows[0].setback_m"),
        ({"building_rows": [BUILDING_ROW | {"from_m": 39.0}]}, "building_rows[0]"),
        ({"obstacle_rows": [OBSTACLE_ROW | {"from_m": 39.0, "offset_m": 4.0}]}, "obstacle_rows[0]"),
        ({"obstacle_rows": [OBSTACLE_ROW | {"every_m": 0.001}]}, "building_rows and obstacle_rows"),
        ({"obstacle_rows": [OBSTACLE_ROW | {"to_m": 0.0}]}, "obstacle_rows[0]"),
        ({"obstacles.0.size_m": [4.0, 1.8, 0.6]}, "obstacles[0]"),
        ({"pedestrian_groups.1.walk.at_m": MISSING}, "pedestrian_groups[1].walk"),
        ({"pedestrian_groups.1.walk.offset_m": 30.0}, "pedestrian_groups[1].walk"),
        ({"pedestrian_groups.0.walk.to_m": 5.0}, "pedestrian_groups[0].walk"),
        ({"pedestrian_groups.1.walk": POINTS}, "pedestrian_groups[1].walk"),
        ({"categories.1": "sky"}, "categories"),
        ({"zones.1.name": "south"}, "zones"),
        ({"camera.width_px": 1_000_000}, "camera.width_px"),  # such maps are TB
        # Names of nothing, and places off their road.
        ({"pedestrian_groups.0.count": 84}, "pedestrian_groups"),
        ({"categories.0": "heaven"}, "categories"),
        ({"categories": ["sky", "road"]}, "obstacles"),
        ({"terrain_m": 9.0}, "terrain_m"),
        ({"zones.0.road": "stam"}, "zones.south.road"),
        ({"paths.0.end": "north"}, "paths.left"),
        ({"paths.0.closures": ["up"]}, "paths.left.closures"),
        ({"pedestrian_groups.1.walk.road": "up"}, "pedestrian_groups.across.walk.road"),
        ({"zones.1.to_m": 99.0}, "zones.west"),
        ({"zones.1.from_m": 69.5}, "zones.west"),
        ({"closures.0.at_m": 99.0}, "closures.left_arm"),
        ({"pedestrian_groups.1.walk.at_m": 99.0}, "pedestrian_groups.across.walk"),
        ({"categories": ALL, "crosswalks": [CROSSWALK | {"at_m": 50.0}]}, "crosswalks[0]"),
        # Paths that are blocked.
        ({"vehicle.width_m": 9.0}, "paths.left: starts off the road"),
        ({"obstacles.0.center_m": [3.0, 0.0]}, "paths.left: its start is blocked"),
        (
            {"closures.1.at_m": 65.0, "paths.1.closures": ["right_arm"]},
            "paths.right: its end zone is blocked",
        ),
        ({"paths.0.closures": ["left_arm"]}, "paths.left: no free road leads from 'south' to 'w"),
        ({"paths.0.end": "south"}, "paths.left: starts inside"),
        # It starts at 3 m, in the middle of south, and would end from 2 m on.
        ({"zones.1": ON_STEM}, "paths.left: starts inside"),
        # People in the way. Lanes begin at 3.7 m, people reach 0.3 m to either side, and the
        # vehicle to 3.5 m.
        ({"pedestrian_groups.1.walk.at_m": 4.2}, "pedestrian_groups.across.walk: people can"),
        ({"obstacles.0.center_m": [25.0, 0.0]}, "pedestrian_groups.across.walk: goes through"),
        # 0.2 m beside the walk: a person is 0.3 m to either side.
        ({"obstacles": [CAR_BESIDE]}, "pedestrian_groups.across.walk: goes through a car at (22.8"),
    ],
)  # fmt: skip
def test_an_invalid_scene_is_refused_with_its_key(data, changes, key):
    assert refusal(data, changes).startswith(f"{key}: " if ":" not in key else key)


def test_a_house_on_the_road_blocks_it(data):
    # A lane from the south ends 8 m below the stem's axis; the house beyond its end is built from
    # there over the stem, 6 m wide and 12 m deep.
    lane = {"name": "lane", "start_m": [20.0, -30.0], "heading_deg": 90.0, "width_m": 6.0}
    lane |= {"sidewalk_m": 0.0, "pieces": [{"straight_m": 22.0}]}
    house = {"road": "lane", "side": "end", "from_m": 0.0, "to_m": 0.0, "setback_m": 0.0}
    house |= {"front_m": [6.0, 6.0], "depth_m": [12.0, 12.0], "height_m": [8.0, 8.0]}
    data |= {"pedestrian_groups": [], "obstacles": [], "roads": [*data["roads"], lane]}
    load_scene(data)
    assert refusal(data, {"building_rows": [house]}).startswith("paths.left: no free road")


def test_an_ending_zone_may_be_a_metre_long(data):
    data["zones"][1] |= {"from_m": 63.1, "to_m": 64.1}  # 0.99999... in floating point
    assert load_scene(data).zones[1].to_m == 64.1


@pytest.mark.parametrize(
    ("group", "changes", "says"),
    [
        # Lanes are 0.61 m apart.
        ("across", {"count": 3}, ".spread_m: is 1.0, but 3 people need lanes 1.22 m"),
        # They reach to 0.5 m beside 25 m, and to 0.7 m beside 26.5 m.
        ("along", {"walk": ACROSS | {"at_m": 26.5}}, ": people of 'across' come within 0.30 m"),
        ("along", {"walk": through((15, 0), (35, 0))}, ": people of 'across' come within 0.00 m"),
        ("across", {"walk": through((9, 0), (9, 0))}, ".walk: has no length"),
        ("across", {"walk": through((9, 0), (20, 0), (20, 1.4), (9, 1.4))}, ".walk: comes"),
        ("across", {"count": 1, "walk": through((9, 0), (20, 0), (20, 0.4))}, ".walk: comes"),
    ],
)
def test_walks_on_which_people_could_overlap_are_refused(data, group, changes, says):
    next(each for each in data["pedestrian_groups"] if each["name"] == group).update(changes)
    assert refusal(data, {}).startswith(f"pedestrian_groups.{group}{says}")
