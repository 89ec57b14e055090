"""The paper's four environments: Table I, their paths, what is seen there, that they are fair.

Counts are small here; `examples/scene_validity.py` runs hundreds of episodes a cell.
"""

from dataclasses import replace

import gymnasium
import pytest
import shapely
from gymnasium.utils.env_checker import check_env

from flowrep.baselines import Planner
from flowrep.envs import SCENE_BY_ID
from flowrep.envs.street_env import Episode, Moment
from flowrep.scenes import load_scene, scene_names
from flowrep.scenes.layout import Layout, free_ground
from flowrep.scenes.vehicle import VehicleState
from flowrep.simulator.meshes import kerb, lane_marks

PEOPLE = {"across", "along", "standing"}
# Paper, Table I: steps, paths, lane width factor, categories, kinds of pedestrians, α in °/s².
TABLE_1 = {
    "straight_road": (200, 1, 2.0, 5, {"across"}, 35.0),
    "s_turn": (250, 2, 1.5, 6, {"across"}, 70.0),
    "h_shaped_pathways": (300, 4, 2.0, 7, PEOPLE, 70.0),
    "three_way_junction": (250, 2, 1.0, 11, {"along"}, 70.0),
}
LANE_M = 3.5  # one unit of the lane width factor
TURNING = [name for name in TABLE_1 if name != "straight_road"]


def kinds_of_people(scene):
    walking = {g.walk.kind for g in scene.pedestrian_groups if g.standing < g.count}
    return walking | {"standing" for g in scene.pedestrian_groups if g.standing}


@pytest.mark.parametrize("name", TABLE_1)
def test_a_scene_has_the_numbers_of_the_paper(name):
    steps, paths, lane, categories, people, alpha = TABLE_1[name]
    scene = load_scene(name)
    assert scene.time_limit_steps == steps
    assert len(scene.paths) == paths
    assert {road.width_m for road in scene.roads} == {lane * LANE_M}
    assert len(scene.categories) == categories
    assert kinds_of_people(scene) == people
    assert scene.vehicle.yaw_acceleration_dps2 == alpha
    assert (scene.vehicle.speed_mps, scene.frame_rate_hz) == (10.0, 12.0)
    has_obstacles = bool(scene.obstacles or scene.obstacle_rows)
    assert has_obstacles == (name == "three_way_junction")
    speeds = {"low": (0.6, 1.0), "normal": (1.2, 1.8), "high": (2.0, 2.4)}
    assert scene.pedestrian_speed_mps == speeds
    assert scene.camera == load_scene("straight_road").camera
    assert set(scene_names()) == set(SCENE_BY_ID.values()) == set(TABLE_1)


@pytest.mark.slow_after_first
@pytest.mark.parametrize("env_id", SCENE_BY_ID)
def test_gymnasium_makes_and_checks_every_scene(env_id):
    env = gymnasium.make(env_id, render_mode="rgb_array")
    assert env.unwrapped.scene.name == SCENE_BY_ID[env_id]
    check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("name", TURNING)
def test_every_path_is_drawn_equally_often(name):
    layout = Layout(replace(load_scene(name), pedestrian_groups=()))
    draws, paths = 200, layout.scene.paths
    drawn = [Episode(layout, 12.0, seed, (0.0, 0.0), 0.0).path for seed in range(draws)]
    # Four standard deviations of a binomial count.
    spread = 4 * (draws / len(paths) * (1 - 1 / len(paths))) ** 0.5
    for path in paths:
        assert abs(drawn.count(path) - draws / len(paths)) < spread


@pytest.mark.parametrize("name", ["h_shaped_pathways", "three_way_junction"])
def test_the_only_way_out_is_the_path_s_own_ending_zone(name):
    layout = Layout(load_scene(name))
    ends = {path.end for path in layout.scene.paths}
    for path in layout.scene.paths:
        start = shapely.Point(layout.start_state(path.start)[:2])
        pieces = shapely.get_parts(free_ground(layout, path))
        (reached,) = [piece for piece in pieces if piece.covers(start)]
        assert [end for end in ends if reached.intersects(layout.zones[end])] == [path.end]


CLOSED_EXITS = [
    # (scene, what is driven, where, the exit that is closed there)
    ("h_shaped_pathways", "south_to_north", "south_to_south", "northeast"),
    ("h_shaped_pathways", "north_to_south", "north_to_north", "southeast"),
    ("three_way_junction", "left", "right", "left"),
    ("three_way_junction", "right", "left", "right"),
]


def driven_to_its_end(env, actions, **options):
    """Drives an episode with the given actions and returns how it ended."""
    env.reset(seed=0, options=options)
    infos = (env.step(action)[4] for action in actions)
    return next((info["outcome"], info["hit"]) for info in infos if info["outcome"] != "running")


@pytest.mark.slow_after_first
@pytest.mark.parametrize(("name", "driven", "path", "closed"), CLOSED_EXITS)
def test_a_closed_exit_ends_the_drive_into_it(make_street, name, driven, path, closed):
    env = make_street(replace(load_scene(name), pedestrian_groups=()), sensors=())
    env.reset(seed=0, options={"path": driven})
    actions = Planner().search(env.episode)
    assert driven_to_its_end(env, actions, path=driven)[0] == "success"
    assert driven_to_its_end(env, actions, path=path) == ("collision", "building")
    # Right there: the vehicle's middle is no further off than half its diagonal, a square metre's.
    x, y = env.episode.now.vehicle[:2]
    front = Layout(env.scene).closures[closed].footprint.exterior.distance(shapely.Point(x, y))
    assert front < 0.5 * 2**0.5 + 1e-6


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    ("name", "paths", "x_m"),
    [
        ("three_way_junction", ("left", "right"), 52.0),  # the arms part at 62
        ("h_shaped_pathways", ("south_to_north", "south_to_south"), 50.0),  # they turn off at 60
    ],
)
def test_which_exit_is_closed_is_seen_a_second_before_the_turn(make_street, name, paths, x_m):
    scene = load_scene(name)
    laptop = replace(scene.camera, height_px=48, width_px=48, fov_deg=60.0)
    scene = replace(scene, camera=laptop, pedestrian_groups=())
    env, depths = make_street(scene, sensors=("depth",)), []
    for path in paths:
        env.reset(seed=0, options={"path": path})
        here = Moment(VehicleState(x_m, 0.0, 0.0, 0.0), 0)
        env.episode.resume(here, here)
        depths.append(env.sensing.observe(env.episode)["depth"][0])
    left_open, right_open = depths
    closed_right, closed_left = left_open < right_open - 1.0, right_open < left_open - 1.0
    for closed, half in ((closed_right, slice(24, None)), (closed_left, slice(None, 24))):
        assert closed.sum() >= 20
        assert closed.sum() == closed[:, half].sum()


SPEEDS = ["low", "normal", "high"]


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    ("name", "speed", "planned", "others", "straight", "by_chance"),
    [
        # With 60 episodes a true share of 12 % gives more than 15 in less than one run in 1,000.
        *(("straight_road", speed, 5, 60, 15, 6) for speed in SPEEDS),
        # A bend ahead: straight on leads off the road or into somebody.
        *((name, speed, 2, 12, 0, 0) for name, speed in zip(TURNING, SPEEDS)),
    ],
)
def test_the_planner_succeeds_where_never_turning_and_random_actions_seldom_do(
    drive, name, speed, planned, others, straight, by_chance
):
    def successes(baseline, count):
        return sum(e.outcome == "success" for e in drive(baseline, count, name, speed=speed))

    assert successes("planner", planned) == planned
    assert successes("never_turn", others) <= straight
    assert successes("random", others) <= by_chance


@pytest.mark.parametrize("name", scene_names())
def test_the_kerb_is_on_the_sidewalk_and_paving_is_below_it(name):
    layout = Layout(load_scene(name))
    stones = kerb(layout.drivable, layout.sidewalks).triangles[0]
    stone = shapely.union_all(shapely.polygons(stones[:, :, :2]))
    assert stone.difference(layout.sidewalks.buffer(1e-6)).area == 0
    # A quarter of a metre all along the road, where there is a sidewalk.
    along = layout.drivable.boundary.intersection(layout.sidewalks.buffer(1e-6)).length
    assert stone.area == pytest.approx(0.25 * along, rel=0.02)
    assert (stones[..., 2] > 0).all()  # or it would flicker with the paving


def test_lane_marks_stop_where_crosswalks_and_other_roads_are():
    layout = Layout(load_scene("h_shaped_pathways"))
    striped = shapely.union_all([area.polygon for area in layout.crosswalks])
    west = layout.ribbons["west"]
    others = shapely.union_all([west, layout.ribbons["east"], striped])
    marks = lane_marks(layout.lines["bar"], others)
    points = shapely.points(marks.triangles[0].reshape(-1, 3)[:, :2])
    # 70 m of bar less half a leg at either end and the crosswalk: ten dashes, six metres apart.
    assert len(points) > 30
    assert not shapely.intersects(points, striped).any()
    assert not shapely.intersects(points, west).any()
