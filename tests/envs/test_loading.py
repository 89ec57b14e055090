"""Scenes from data: what is read, and what is refused with file, key and remedy."""

import copy
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from flowrep.envs import Planner, SceneError, drives, load_scene
from flowrep.envs.layout import Layout

CROSSROADS = Path(__file__).parent / "crossroads.yaml"


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
    env = make_street(CROSSROADS)
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
        ({"vehicle__speed_mps": KeyError}, "vehicle.speed_mps: missing key; add it, a number"),
        ({"vehicle__speed_mps": "fast"}, "vehicle.speed_mps: got 'fast'; give a number"),
        ({"time_limit_steps": 1.5}, "time_limit_steps: got 1.5; give a whole number"),
        ({"time_limit_steps": True}, "time_limit_steps: got True; give a whole number"),
        ({"camera": 3}, "camera: expected a mapping, got 3; write its keys"),
        ({"roads__0__start_m": [1.0]}, "roads[0].start_m: expected 2 values, got 1; a list of 2"),
        ({"roads": "stem"}, "roads: expected a list, got 'stem'; a list"),
        (
            {"pedestrian_groups__0__draw": "each"},
            "pedestrian_groups[0].draw: unknown value 'each'; choose one of ['group', ",
        ),
        (
            {"pedestrian_speed_mps__low": KeyError},
            "pedestrian_speed_mps: has keys ['high', 'normal']",
        ),
        ({"pedestrian_speed_mps": 2}, "pedestrian_speed_mps: expected a mapping, got 2"),
        ({"pedestrian_speed_mps__low": [2, 1]}, "pedestrian_speed_mps.low: is [2.0, 1.0]; give"),
        ({"frame_rate_hz": 0}, "frame_rate_hz: is 0.0; give a number above 0"),
        ({"camera__fov_deg": 180}, "camera.fov_deg: is 180.0; stay in (0, 180)"),
        ({"camera__far_m": 0.1}, "camera.far_m: is not beyond near_m; give a larger far_m"),
        ({"pedestrian_groups__0__count": 300}, "pedestrian_groups: 302 people, but instance ids"),
        (
            {"pedestrian_groups__0__standing": 4},
            "pedestrian_groups.along.standing: is 4; stay in 0",
        ),
        ({"roads__0__pieces__0": {}}, "roads.stem.pieces[0]: neither a straight piece nor an arc"),
        ({"roads__0__pieces__0": {"straight_m": -1}}, "roads.stem.pieces[0]: has no length; give"),
        ({"categories__0": "heaven"}, "categories: unknown name 'heaven'; choose from ['sky', "),
        (
            {"categories": ["sky", "road"]},
            "obstacles: unknown name 'car'; choose from ['sky', 'road",
        ),
        ({"zones__1__name": "south"}, "zones: two are named 'south'; rename one of them"),
        ({"paths": []}, "paths: is empty; name a start zone and an ending zone"),
        (
            {"zones__0__road": "stam"},
            "zones.south.road: unknown name 'stam'; choose from ['stem', ",
        ),
        ({"paths__0__end": "north"}, "paths.left: unknown name 'north'; choose from ['south', "),
        ({"paths__0__closures": ["up"]}, "paths.left.closures: unknown name 'up'; choose from"),
        ({"closures__0__road": "up"}, "closures.road: unknown name 'up'; choose from ['stem', "),
        (
            {"pedestrian_groups__1__walk__at_m": KeyError},
            "pedestrian_groups.across.walk.at_m: missing key; a walk of kind 'across' needs road",
        ),
        ({"pedestrian_groups__1__walk__road": "up"}, "pedestrian_groups.across.walk.road: unknown"),
        (
            {"zones__1__to_m": 99.0},
            "zones.west: [60.0, 99.0] m is not on road 'to_left'; stay within",
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
    ],
)
def test_what_cannot_be_is_refused(data, changes, expected):
    assert refuse(data, **changes).startswith(expected)


def test_files_that_cannot_be_read_are_named(tmp_path):
    with pytest.raises(SceneError, match=r"scene 'straight': .*choose one of .*straight_road"):
        load_scene("straight")
    missing = tmp_path / "none.yaml"
    with pytest.raises(SceneError, match=r"none.yaml: .*no such file"):
        load_scene(missing)
    broken = tmp_path / "broken.yaml"
    broken.write_text("name: [1\n")
    with pytest.raises(SceneError, match=r"broken.yaml: .*not YAML"):
        load_scene(broken)
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(CROSSROADS.read_text().replace("layout_seed: 3", "layout_sed: 3"))
    with pytest.raises(SceneError, match=r"wrong.yaml: layout_sed: unknown key"):
        load_scene(wrong)
