"""What can't be a scene is refused, and the message names the key."""

import copy
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from flowrep.scenes import SceneError, load_scene
from flowrep.scenes.scene import PedestrianGroup, Walk

NAN, INF = float("nan"), float("inf")
MISSING = object()
CROSSROADS = Path(__file__).parent / "crossroads.yaml"
ALL = ["sky", "road", "sidewalk", "building", "pedestrian", "car", "crosswalk"]
CROSSWALK = {"road": "stem", "at_m": 20.0, "depth_m": 3.0}
BUILDING_ROW = {"road": "stem", "side": "left", "from_m": 0.0, "to_m": 40.0, "setback_m": 2.0}
BUILDING_ROW |= {"front_m": [7, 9], "depth_m": [6, 9], "height_m": [5, 9]}
OBSTACLE_ROW = {"road": "stem", "kind": "house", "offset_m": 8.0, "from_m": 0.0, "to_m": 40.0}
OBSTACLE_ROW |= {"every_m": 9.0, "size_m": [1.0, 1.0, 1.0]}
POINTS = {"kind": "points", "road": "stem", "points_m": [[25.0, -5.0], [25.0, 5.0]]}
ON_STEM = {"name": "west", "road": "stem", "from_m": 2.0, "to_m": 9.0}


@pytest.fixture
def data():
    return yaml.safe_load(CROSSROADS.read_text())


def refusal(data, changes):
    """Returns the message that refuses the data with a value at each dotted key."""
    data = copy.deepcopy(data)
    for key, value in changes.items():
        *parents, last = [int(part) if part.isdigit() else part for part in key.split(".")]
        at = data
        for parent in parents:
            at = at[parent]
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
    ("changes", "named"),
    [
        # Types and ranges.
        ({"camera.fov": 90}, "camera.fov: unknown key"),
        ({"vehicle.speed_mps": MISSING}, "vehicle.speed_mps: missing"),
        ({"vehicle.speed_mps": "fast"}, "vehicle.speed_mps: got 'fast'"),
        ({"vehicle.speed_mps": "10"}, "vehicle.speed_mps: got '10'"),
        ({"vehicle.speed_mps": INF}, "vehicle.speed_mps: got inf"),
        ({"vehicle.speed_mps": 0}, "vehicle.speed_mps: got 0"),
        ({"time_limit_steps": 1.5}, "time_limit_steps: got 1.5"),
        ({"time_limit_steps": True}, "time_limit_steps: got True"),
        ({"camera": 3}, "camera: got 3"),
        ({"camera.fov_deg": 180}, "camera.fov_deg: got 180"),
        ({"camera.pitch_deg": NAN}, "camera.pitch_deg: got nan"),
        ({"frame_rate_hz": 0}, "frame_rate_hz: got 0"),
        ({"layout_seed": -1}, "layout_seed: got -1"),
        ({"name": "../../up"}, "name: got '../../up'"),
        ({"roads": "stem"}, "roads: got 'stem'"),
        ({"roads.0.name": ""}, "roads[0].name: got ''"),
        ({"roads.0.start_m": [1.0]}, "roads[0].start_m[1]: missing"),
        ({"roads.0.pieces": []}, "roads[0].pieces: got []"),
        ({"roads.0.pieces.0": {"straight_m": -1}}, "roads[0].pieces[0].straight_m: got -1"),
        ({"roads.1.pieces.0.arc_deg": 1e5}, "roads[1].pieces[0].arc_deg: got 100000.0"),
        ({"paths": []}, "paths: got []"),
        ({"pedestrian_groups.0.draw": "each"}, "pedestrian_groups[0].draw: got 'each'"),
        ({"pedestrian_groups.0.speed_mps": [2, 1]}, "pedestrian_groups[0].speed_mps: got [2, 1]"),
        ({"pedestrian_speed_mps": 2}, "pedestrian_speed_mps: got 2"),
        ({"pedestrian_speed_mps.low": MISSING}, "pedestrian_speed_mps: got"),
        ({"pedestrian_speed_mps.low": [2, 1]}, "pedestrian_speed_mps.low: got [2, 1]"),
        ({"obstacles.0.kind": "lorry"}, "obstacles[0].kind: got 'lorry'"),
        ({"obstacles.0.size_m": [4, 0, 1]}, "obstacles[0].size_m[1]: got 0"),
        ({"building_rows": [BUILDING_ROW | {"front_m": [0, 0]}]}, "building_rows[0].front_m[0]"),
        ({"building_rows": [BUILDING_ROW | {"front_m": [9, 7]}]}, "building_rows[0].front_m"),
        ({"obstacle_rows": [OBSTACLE_ROW | {"every_m": 0}]}, "obstacle_rows[0].every_m"),
        ({"terrain_m": -1.0}, "terrain_m: got -1.0"),
        # Parts that don't agree.
        ({"camera.far_m": 0.1}, "camera.far_m"),
        ({"pedestrian_groups.0.count": 84}, "pedestrian_groups: 86 people"),
        ({"pedestrian_groups.0.standing": 4}, "pedestrian_groups.along.standing"),
        ({"roads.0.pieces.0": {}}, "roads.stem.pieces[0]"),
        ({"roads.1.pieces.0.arc_deg": 0.0}, "roads.to_left.pieces[0].arc_deg"),
        ({"building_rows": [BUILDING_ROW | {"to_m": -9}]}, "building_rows[0]"),
        ({"building_rows": [BUILDING_ROW | {"side": "end"}]}, "building_rows[0]"),
        ({"obstacle_rows": [OBSTACLE_ROW | {"to_m": 0.0}]}, "obstacle_rows[0]"),
        ({"obstacles.0.size_m": [4.0, 1.8, 0.6]}, "obstacles[0].size_m[2]: is 0.6"),
        ({"categories.0": "heaven"}, "categories: unknown name 'heaven'"),
        ({"categories.1": "sky"}, "categories: two are named 'sky'"),
        ({"categories": ["sky", "road"]}, "obstacles: unknown name 'car'"),
        ({"terrain_m": 9.0}, "terrain_m: unknown name 'terrain'"),
        ({"crosswalks": [CROSSWALK]}, "crosswalks: unknown name 'crosswalk'"),
        ({"zones.1.name": "south"}, "zones: two are named 'south'"),
        ({"zones.0.road": "stam"}, "zones.south.road: unknown name 'stam'; choose from ['stem'"),
        ({"paths.0.end": "north"}, "paths.left: unknown name 'north'"),
        ({"paths.0.closures": ["up"]}, "paths.left.closures: unknown name 'up'"),
        ({"closures.0.road": "up"}, "closures[0].road: unknown name 'up'"),
        ({"pedestrian_groups.1.walk.road": "up"}, "pedestrian_groups.across.walk.road"),
        ({"pedestrian_groups.1.walk.at_m": MISSING}, "pedestrian_groups.across.walk.at_m: missing"),
        ({"pedestrian_groups.1.walk.offset_m": 30.0}, "pedestrian_groups.across.walk.offset_m"),
        ({"pedestrian_groups.1.walk.points_m": [[0.0, 0.0]]}, "pedestrian_groups.across.walk.poin"),
        ({"pedestrian_groups.0.walk.at_m": 9.0}, "pedestrian_groups.along.walk.at_m"),
        ({"pedestrian_groups.1.walk": POINTS}, "pedestrian_groups.across.walk.road"),
        # Places off the road or without length.
        ({"zones.1.to_m": 99.0}, "zones.west: 60 to 99 m is not on road 'to_left'"),
        ({"zones.0.from_m": 5.0}, "zones.south: has no length"),
        ({"zones.0.from_m": 5.5}, "zones.south: [5.5, 5.0] m runs backwards"),
        ({"zones.1.from_m": 69.5}, "zones.west: ends a path and is 0.5 m long"),
        ({"closures.0.at_m": 99.0}, "closures.left_arm.at_m: 99 m is not on road"),
        ({"pedestrian_groups.1.walk.at_m": 99.0}, "pedestrian_groups.across.walk: 99 m is not on"),
        ({"pedestrian_groups.0.walk.to_m": 5.0}, "pedestrian_groups.along.walk: has no length"),
        (
            {"categories": ALL, "crosswalks": [CROSSWALK | {"at_m": 50.0}]},
            "crosswalks[0].at_m: 50 m is not on road 'stem'",
        ),
        # Paths that are blocked.
        ({"vehicle.width_m": 9.0}, "paths.left: starts off the road"),
        ({"obstacles.0.center_m": [3.0, 0.0]}, "paths.left: its start collides"),
        (
            {"closures.1.at_m": 65.0, "paths.1.closures": ["right_arm"]},
            "paths.right: its ending zone is built over",
        ),
        ({"paths.0.closures": ["left_arm"]}, "paths.left: no free road leads from 'south' to 'w"),
        ({"paths.0.end": "south"}, "paths.left: starts inside its ending zone 'south'"),
        # It starts at 3 m, in the middle of south, and would end from 2 m on.
        ({"zones.1": ON_STEM}, "paths.left: starts inside its ending zone 'west'"),
        # People in the way. Lanes begin at 3.7 m, people reach 0.3 m to either side, and the
        # vehicle to 3.5 m.
        ({"pedestrian_groups.1.walk.at_m": 4.2}, "pedestrian_groups.across.walk: people can"),
        ({"obstacles.0.center_m": [25.0, 0.0]}, "pedestrian_groups.across.walk: goes through"),
        ({"pedestrian_groups.0.walk.to_m": 60.0}, "pedestrian_groups.along.walk: goes through"),
        (  # 0.2 m beside the walk: a person is 0.3 m to either side
            {"obstacles.0.center_m": [22.8, 2.0], "obstacles.0.yaw_deg": 0.0},
            "pedestrian_groups.across.walk: goes through a car at (22.8, 2.0)",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(data, changes, named):
    assert refusal(data, changes).startswith(named)


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
    load_scene(data)


@pytest.mark.parametrize(
    ("groups", "expected"),
    [
        (
            [PedestrianGroup("three", 3, 1.0, Walk("across", road="main", at_m=50.0))],
            "pedestrian_groups.three.spread_m: is 1.0, but 3 people need lanes 1.22 m wide "
            "together; give 1.22 or more",
        ),
        (
            [
                PedestrianGroup("one", 2, 1.0, Walk("across", road="main", at_m=50.0)),
                PedestrianGroup("two", 2, 1.0, Walk("across", road="main", at_m=51.5)),
            ],
            "pedestrian_groups.one: people of 'two' come within 0.50 m of those of this group; "
            "keep the walks 0.6 m apart: move one of them, or narrow its spread_m",
        ),
        (
            [
                PedestrianGroup("one", 1, 0.0, Walk("across", road="main", at_m=50.0)),
                PedestrianGroup("along", 1, 0.0, Walk("along", road="main", from_m=40, to_m=60)),
            ],
            "pedestrian_groups.one: people of 'along' come within 0.00 m of those",
        ),
        (
            [PedestrianGroup("one", 1, 0.0, Walk("points", points_m=((9.0, 0.0), (9.0, 0.0))))],
            "pedestrian_groups.one.walk: has no length; give two places apart from each other",
        ),
        (
            [
                PedestrianGroup(
                    "back",
                    2,
                    1.0,
                    Walk("points", points_m=((9.0, 0.0), (20.0, 0.0), (20.0, 1.0), (9.0, 1.0))),
                )
            ],
            "pedestrian_groups.back.walk: comes too near to itself, or bends too sharply, for "
            "lanes 1.0 m wide; stretch or straighten the walk",
        ),
    ],
)
def test_people_who_would_stand_in_each_other_are_refused(straight_road, groups, expected):
    with pytest.raises(SceneError) as caught:
        load_scene(replace(straight_road, pedestrian_groups=tuple(groups)))
    assert str(caught.value).startswith(f"scene 'straight_road': {expected}")
