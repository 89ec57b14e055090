"""The gymnasium environment: its contract, the ends of its episodes, and that they come back."""

import json
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from flowrep.envs import StreetEnv
from flowrep.envs.street_env import ticks_for
from flowrep.scenes.scene import Obstacle
from tests.comparing import differing

NO_OP, LEFT, RIGHT = 0, 1, 2


def drive(env, action=NO_OP, **options):
    """Returns the rewards of an episode with one action, and its last info."""
    env.reset(seed=0, options=options)
    rewards, ended = [], False
    while not ended:
        _, reward, ended, truncated, info = env.step(action)
        assert not truncated
        rewards.append(reward)
    return rewards, info


def test_the_observation_has_the_requested_sensors(make_street, straight_road):
    camera = replace(straight_road.camera, height_px=20, width_px=30)
    parts = 3 * straight_road.num_pedestrians
    asked = {
        "rgb": ((3, 20, 30), "uint8"),
        "instance": ((1, 20, 30), "uint8"),
        "frame": ((2,), "int64"),
        "depth": ((1, 20, 30), "float32"),
        "semantic": ((1, 20, 30), "uint8"),
        "instance_motion": ((1 + parts, 4, 4), "float32"),
        "prev_from_curr": ((4, 4), "float32"),
    }
    env = make_street(replace(straight_road, camera=camera), sensors=tuple(asked))
    observation, _ = env.reset(seed=0)
    seen = {key: (value.shape, value.dtype.name) for key, value in observation.items()}
    assert list(seen.items()) == list(asked.items())
    assert [*make_street(straight_road, sensors="depth").observation_space] == ["depth"]


def test_the_frame_sensor_is_the_episode_seed_and_the_step(make_street):
    env = make_street(sensors=("frame",))
    observation, _ = env.reset(options={"episode_seed": 41})
    assert observation["frame"].tolist() == [41, 0]
    for step in (1, 2):
        observation = env.step(0)[0]
        assert observation["frame"].tolist() == [41, step]
    again, _ = env.reset(options={"state": env.get_state()})
    assert again["frame"].tolist() == [41, 2]


def test_maps_show_sky_road_sidewalk_houses_and_people(make_street):
    env = make_street()
    observation, _ = env.reset(seed=0)
    depth, semantic = observation["depth"][0], observation["semantic"][0]
    assert set(np.unique(semantic)) == {0, 1, 2, 3, 4}
    # Sky is where nothing is: at infinity, and nowhere else.
    np.testing.assert_array_equal(np.isinf(depth), semantic == 0)
    # Instances are the people's parts, numbered from 1.
    np.testing.assert_array_equal(observation["instance"][0] > 0, semantic == 4)
    assert semantic[-1, 42] == 1  # the road before the vehicle
    # 50 rows down a ray meets the ground 5 m ahead; 40 columns aside that is 4.75 m left.
    assert semantic[50, 2] == 2
    assert semantic[0, 0] == 3  # a house front
    # The lowest row looks 45° below an axis that dips by 5°: camera height 1.5 m over
    # sin(5°) + 0.988·cos(5°), where 0.988 = (83.5 - 41.5) / 42 less half a pixel's sampling.
    y = (83.5 - env.K[1, 2]) / env.K[1, 1]
    z = 1.5 / (math.sin(math.radians(5)) + y * math.cos(math.radians(5)))
    assert depth[-1, 42] == pytest.approx(z, rel=1e-4)


@pytest.mark.parametrize(
    ("outcome", "rate_hz", "speed_mps", "action", "steps"),
    [
        # 150 m at 10 m/s are 15 s; one step more where rounding leaves it on the edge.
        ("success", 12, 10.0, NO_OP, (180, 181)), ("success", 6, 10.0, NO_OP, (90, 91)),
        # Yaw grows as 35°/s² t²/2; y as its integral, 10·0.61·t³/6 = 1.02 t³: 3 m in about 1.4 s.
        ("out_of_bounds", 12, 10.0, LEFT, (14, 18)), ("out_of_bounds", 12, 10.0, RIGHT, (14, 18)),
        # 200 steps at 12 Hz are 16.67 s; at 7 Hz these are 116.7 steps: the 117th is too late.
        # 200 / 12 · 15 is 250.00000000000003 in floating point.
        ("timeout", 12, 0.0, NO_OP, (200, 200)), ("timeout", 6, 0.0, NO_OP, (100, 100)),
        ("timeout", 7, 0.0, NO_OP, (117, 117)), ("timeout", 15, 0.0, NO_OP, (250, 250)),
    ],
)  # fmt: skip
def test_an_episode_ends_after_its_seconds_at_any_frame_rate(
    make_street, empty_road, outcome, rate_hz, speed_mps, action, steps
):
    env = make_street(empty_road, frame_rate_hz=rate_hz, sensors=())
    rewards, info = drive(env, action, vehicle_speed_mps=speed_mps)
    assert (info["outcome"], info["hit"]) == (outcome, "")
    assert steps[0] <= len(rewards) <= steps[1]
    last = 5.0 if outcome == "success" else -5.0
    assert sum(rewards) == pytest.approx(last + 0.01 * len(rewards))


@pytest.mark.parametrize(
    ("rate_hz", "size"), [(12.0, 1.0), (6.0, 1.0), (3.0, 1.0), (6.0, 2.0), (6.0, (1.0, 3.0))]
)
def test_no_frame_rate_lets_the_vehicle_pass_through_a_person(
    make_street, one_stands, rate_hz, size
):
    scene = replace(one_stands, pedestrian_size=size)
    env = make_street(scene, frame_rate_hz=rate_hz, sensors=())
    rewards, info = drive(env)
    assert (info["outcome"], info["hit"]) == ("collision", "pedestrian")
    # Looked at 24 times a second, wherever the frames lie: at the 71st look it is at 29.58 m, at
    # the 70th at 29.17 m. It touches the person at 30 - 0.5 - 0.3 = 29.2 m, and one of twice the
    # size, with a radius of 0.6 m, at 28.9 m. Of sizes 1 to 3, the first person has 2.24: 28.83 m.
    looks = 71 if size == 1.0 else 70
    assert env.episode.now.ticks == looks
    assert env.episode.now.vehicle.x_m == pytest.approx(looks * 10 / 24)
    # The front, 0.5 m ahead, meets a cylinder of 0.3 m at x = 29.2: after 2.92 s.
    assert len(rewards) == math.ceil(2.92 * rate_hz)
    assert sum(rewards) == pytest.approx(-5.0 + 0.01 * len(rewards))


def test_each_person_is_hit_by_their_own_size(make_street, one_stands):
    (person,) = one_stands.pedestrian_groups
    there = replace(person.walk, points_m=((60.0, 0), (60.0, 1)))
    behind = replace(person, name="behind", walk=there)
    scene = replace(one_stands, pedestrian_groups=(behind, person), pedestrian_size=(0.2, 3.0))
    env = make_street(scene, sensors=())
    drive(env)
    # The first has 1.93; the second, 0.2 + 0.236 · 2.8 = 0.86: a radius of 0.26 m, at 29.24,
    # after 70 looks at 29.17. One of 1.93 would be at 28.92.
    assert env.episode.now.ticks == 71


def test_no_speed_lets_the_vehicle_pass_through_a_fence_or_a_person(
    make_street, empty_road, one_stands
):
    # Looked at 24 times a second, 40 m/s lead from 68.33 to 70 m: past a fence 0.1 m thick that the
    # vehicle, 1 m long, touches within 0.55 m; 100 m/s lead from 29.17 to 33.33 m, past one who
    # stands at 30 m and whom it touches within 0.8 m.
    fence = Obstacle("fence", (69.17, 1.0), 90.0, (5.0, 0.1, 1.1))
    fenced = replace(empty_road, obstacles=(fence,), categories=(*empty_road.categories, "fence"))
    for scene, speed_mps, expected in ((fenced, 40.0, "fence"), (one_stands, 100.0, "pedestrian")):
        _, info = drive(make_street(scene, sensors=()), vehicle_speed_mps=speed_mps)
        assert (info["outcome"], info["hit"]) == ("collision", expected)


@pytest.mark.parametrize(
    ("rate_hz", "walking_mps", "driving_mps", "length_m", "ticks"),
    [
        # Up to 10 m/s 24 looks a second, or one a frame.
        (7.0, 2.4, 10.0, 1.0, 4),
        (30.0, 2.4, 0.0, 1.0, 1),
        # A look every 10/24 m: 96 and 48 a second.
        (12.0, 2.4, 40.0, 1.0, 8),
        (12.0, 20.0, 10.0, 1.0, 4),
        # A vehicle of 0.1 m moves no further than that: 100 a second.
        (12.0, 2.4, 10.0, 0.1, 9),
    ],
)
def test_the_fastest_body_determines_the_number_of_ticks(
    straight_road, rate_hz, walking_mps, driving_mps, length_m, ticks
):
    scene = replace(straight_road, vehicle=replace(straight_road.vehicle, length_m=length_m))
    assert ticks_for(scene, rate_hz, (0.6, walking_mps), driving_mps) == ticks


def test_an_action_is_a_whole_number_of_any_kind(make_street, empty_road):
    env = make_street(empty_road, sensors=())
    env.reset(seed=0)
    for action in (-1, 3, 1.7, "1", None):
        with pytest.raises(ValueError, match="action is"):
            env.step(action)
    assert (env.episode.steps, env.episode.now.vehicle.x_m) == (0, 0.0)
    for number, action in enumerate([1, np.int64(1), np.array(1), torch.tensor(1)], start=1):
        env.step(action)
        # 35°/s² for a twelfth of a second, to the left.
        expected = number * math.radians(35) / 12
        assert env.episode.now.vehicle.yaw_rate_rps == pytest.approx(expected)


def test_the_speed_mode_changes_peoples_speed_alone_which_a_group_has_together(
    make_street, straight_road
):
    seeds = set()
    for speed, (low, high) in straight_road.pedestrian_speed_mps.items():
        env = make_street(speed=speed, sensors=())
        env.reset(seed=3)
        seeds.add(env.episode.seed)
        first, then = map(env.episode.crowd.positions, (0.0, 0.01))
        steps_mps = np.hypot(*(then - first).T) / 0.01
        assert (steps_mps > low - 1e-6).all()
        assert (steps_mps < high + 1e-6).all()
        # Across the road; members may turn about at different times.
        members = straight_road.pedestrian_groups[0].count
        pace = np.abs(then - first)[:, 1].reshape(-1, members)
        np.testing.assert_allclose(pace, np.repeat(pace[:, :1], members, axis=1), rtol=1e-3)
        assert len(np.unique(pace[:, 0].round(6))) == len(pace)
    assert len(seeds) == 1


def test_reset_options_set_speed_and_frame_rate_of_one_episode(make_street):
    """All is as on a street made for them, which sees nothing; its own come back afterwards."""
    given = {"speed": "high", "frame_rate_hz": 7.0}
    shared, made_for = make_street(), make_street(**given, sensors=())
    for env, options in ((shared, given), (made_for, {})):
        env.reset(seed=5, options={"episode_seed": 11} | options)
        for _ in range(3):
            env.step(LEFT)
    assert shared.get_state() == made_for.get_state()
    assert np.array_equal(shared.episode.poses, made_for.episode.poses)
    resumed = make_street()
    again, _ = resumed.reset(options={"state": json.loads(json.dumps(shared.get_state()))})
    assert differing(again, shared.sensing.observe(shared.episode)) == []
    assert differing(shared.step(RIGHT), resumed.step(RIGHT)) == []
    shared.reset(options={"episode_seed": 11})
    assert shared.episode.speed_mps == shared.scene.pedestrian_speed_mps["normal"]
    assert shared.episode.frame_rate_hz == 12.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"speed": "fast"}, r"unknown speed 'fast'.* low, normal, high"),
        ({"speed": (2.0, 1.0)}, r"speed is \(2.0, 1.0\)"),
        ({"speed": (1.0,)}, r"speed is \(1.0,\)"),
        ({"speed": None}, "speed is None"),
        ({"speed": (1.0, 1e8)}, r"speed: is 1e\+08 m/s"),
        ({"speed": ("1", "2")}, r"speed is \('1', '2'\)"),
        ({"frame_rate_hz": 0}, r"frame_rate_hz is 0;"),
        ({"frame_rate_hz": "12"}, r"frame_rate_hz is '12'"),
        ({"frame_rate_hz": [12]}, r"frame_rate_hz is \[12\]"),
        ({"sensors": ("depth", "lidar")}, r"unknown sensors \['lidar'\].* depth, "),
        ({"picture_scale": 1.5}, "picture_scale.* 1.5"),
        ({"picture_scale": 49}, "picture_scale.* 1 to 48, got 49"),  # 49 · 84 px are more than 4K
        ({"picture_scale": "2"}, "picture_scale.* '2'"),
        ({"render_mode": "human"}, "render_mode is 'human'.*HumanRendering"),
    ],
)
def test_invalid_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        StreetEnv(**arguments)


def test_numba_is_imported_only_to_draw(monkeypatch):
    # None is what Python finds where a module can't be imported.
    monkeypatch.setitem(sys.modules, "flowrep.simulator.rasteriser", None)
    StreetEnv(sensors=("prev_from_curr", "frame")).close()
    with pytest.raises(ImportError):
        StreetEnv(picture_scale=7)  # no open env has this camera, which would be shared


def test_without_a_running_episode_the_street_says_to_call_reset_which_opens_it_again(
    make_street, one_stands
):
    env = make_street(one_stands, sensors=("depth",), render_mode="rgb_array")
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(NO_OP)
    drive(env)
    with pytest.raises(RuntimeError, match=r"has ended \(collision\): call reset"):
        env.step(NO_OP)
    before, _ = env.reset(seed=1)
    env.close()
    with pytest.raises(RuntimeError, match="call reset"):
        env.render()
    assert differing(before, env.reset(seed=1)[0]) == []
    assert env.render().shape == (84, 84, 3)


def test_invalid_reset_options_are_refused(make_street, empty_road):
    env = make_street(empty_road, sensors=())
    for option, value, message in (
        ("start", 3, r"unknown reset options \['start'\]"),
        ("path", "left", r"path 'left'.*\['main'\]"),
        ("path", ["main"], r"path \['main'\]"),
        ("episode_seed", 1.7, "episode_seed is 1.7"),
        ("episode_seed", "1", "episode_seed is '1'"),
        ("episode_seed", -1, "episode_seed is -1"),
        ("episode_seed", 1 << 62, "episode_seed is 4611686018427387904"),
        ("vehicle_speed_mps", math.nan, "vehicle_speed_mps is nan"),
        ("vehicle_speed_mps", -10.0, "vehicle_speed_mps is -10.0"),
        ("vehicle_speed_mps", "10", "vehicle_speed_mps is '10'"),
        ("vehicle_speed_mps", 10**400, "vehicle_speed_mps is 10"),
        ("speed", (1.0, math.nan), r"speed is \(1.0, nan\)"),
        ("state", 5, "get_state"),
        ("state", {"steps": 3}, "get_state: .*episode_seed"),
        # A step of a twelfth of a second would lead past all that is seen, 300 m.
        ("vehicle_speed_mps", 1e7, r"vehicle_speed_mps: is 1e\+07 m/s.* 3600 m/s"),
    ):
        with pytest.raises(ValueError, match=message):
            env.reset(options={option: value})
    state = env.reset(seed=0) and env.get_state()
    for broken in ({"outcome": "won"}, {"now": {"ticks": 1}}, {"np_random": {}}):
        with pytest.raises(ValueError, match="get_state"):
            env.reset(options={"state": state | broken})
    with pytest.raises(ValueError, match=r"path.*state"):  # it would be ignored
        env.reset(options={"state": state, "path": "main"})
    last = (1 << 62) - 1
    assert env.reset(options={"episode_seed": np.int64(last)})[1]["episode_seed"] == last


def test_motion_between_two_steps_is_the_one_driven(make_street, empty_road):
    env = make_street(empty_road, sensors=("prev_from_curr", "instance_motion"))
    env.reset(seed=0)
    # Straight on, 10/12 m a step. The camera dips by 5°: forward is z cos 5° - y sin 5°.
    expected, dip = np.eye(4), math.radians(5)
    expected[1:3, 3] = -math.sin(dip) * 10 / 12, math.cos(dip) * 10 / 12
    for _ in range(3):
        observation = env.step(NO_OP)[0]
        np.testing.assert_allclose(observation["prev_from_curr"], expected, atol=1e-6)
        assert observation["instance_motion"].shape == (1, 4, 4)
