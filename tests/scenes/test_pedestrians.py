"""Walks against a timetable worked by hand."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowrep.scenes import load_scene, pedestrians, scene_names
from flowrep.scenes.layout import Layout
from flowrep.scenes.scene import PedestrianGroup, SceneError, Walk
from flowrep.simulator.meshes import person_meshes

# A walks 10 m along x at 1 m/s; B a corner of 4 m along y and 3 m along x at 2 m/s; C stands.
LINES = [
    np.array([(0.0, 0.0), (10.0, 0.0)]),
    np.array([(1.0, 1.0), (1.0, 5.0), (4.0, 5.0)]),
    np.array([(0.0, 2.0), (0.0, 4.0)]),
]


@pytest.fixture
def crowd():
    # C's phase is a quarter of the way there and back: half-way there.
    return pedestrians.Crowd(LINES, np.array([1.0, 2.0, 0.0]), np.array([0.0, 0.0, 0.25]))


@pytest.mark.parametrize(
    ("time_s", "expected"),
    [
        (0.0, [(0, 0), (1, 1), (0, 3)]),
        (1.5, [(1.5, 0), (1, 4), (0, 3)]),
        (3.0, [(3, 0), (3, 5), (0, 3)]),  # B is round its corner
        (4.0, [(4, 0), (3, 5), (0, 3)]),  # and after 7 m on its way back
        (13.0, [(7, 0), (1, 3), (0, 3)]),  # A turned back at 10; B, 26 m on, is 2 m from its start
        (20.0, [(0, 0), (1, 3), (0, 3)]),  # B, 40 m on, has 2 m of its third way back to go
    ],
)
def test_people_walk_to_and_fro_on_schedule(crowd, time_s, expected):
    np.testing.assert_allclose(crowd.positions(time_s), expected, atol=1e-12)
    np.testing.assert_allclose(crowd.poses(time_s)[:, :2], expected, atol=1e-12)


def test_a_change_of_speed_keeps_everyones_position_and_direction(crowd):
    # At 4 s, A is 4 m out and B, 1 m past its turn, on its way back. At 0.5 m/s for 2 s more each
    # is a metre further; at their true speeds A would be at 6 m and B round its corner.
    slower = crowd.all_walking_at(0.5, 4.0)
    np.testing.assert_allclose(slower.positions(4.0), crowd.positions(4.0), atol=1e-9)
    np.testing.assert_allclose(slower.positions(6.0), [(5, 0), (2, 5), (0, 3)], atol=1e-9)


def test_people_look_where_they_walk_and_turn_about_at_the_ends(crowd):
    def looks(time_s, person):
        return crowd.poses(time_s)[person, 2] % (2 * math.pi)

    assert looks(5.0, 0) == pytest.approx(0.0)
    assert looks(15.0, 0) == pytest.approx(math.pi)
    assert looks(10.0, 0) == pytest.approx(math.pi / 2)  # in the middle of turning about
    assert looks(1.0, 1) == pytest.approx(math.pi / 2)  # +y
    assert looks(2.8, 1) == pytest.approx(0.0)  # +x, round the corner


def test_legs_swing_with_the_distance_walked(crowd):
    def swing(time_s, person):
        return crowd.poses(time_s)[person, 3]

    # A walks 1 m/s from phase 0, in step: a stride of 1.4 m takes 1.4 s, its widest at a quarter.
    assert swing(0.0, 0) == pytest.approx(0.0)
    assert swing(0.35, 0) == pytest.approx(0.38)
    assert swing(1.05, 0) == pytest.approx(-0.38)
    assert swing(1.4 * 7 + 0.35, 0) == pytest.approx(0.38)  # 10.15 m: on, past the about-turn
    # Back at the start after 20 m the stride goes on: 0.75 m into the 15th one.
    assert swing(20.35, 0) == pytest.approx(0.38 * math.sin(2 * math.pi * 0.75 / 1.4))
    # B is 2.4 rad ahead of A and twice as fast; C stands with one foot before the other.
    assert swing(0.35, 1) == pytest.approx(0.38 * math.sin(math.pi + 2.4))
    assert swing(3.21, 2) == swing(0.0, 2) == pytest.approx(0.38)


# At (5, 2), looking along +y: its left is -x. The left leg swings back by 30°.
POSE = np.array([[5.0, 2.0, math.pi / 2, math.radians(30.0)]])
HIP_M, LEG_M = 0.82, 0.82


def test_a_leg_swings_back_while_the_other_swings_forward_and_the_body_only_turns():
    body, left, right = pedestrians.world_from_parts(POSE, np.ones(1))
    np.testing.assert_allclose(body @ [1.0, 0.0, 1.2, 1.0], [5.0, 3.0, 1.2, 1.0], atol=1e-12)
    foot = np.array([0.0, 0.0, -LEG_M, 1.0])
    # sin 30° = 0.5: the foot is 0.41 m behind or before the hip and at 0.82·(1 - cos 30°) m.
    height = HIP_M - LEG_M * math.cos(math.radians(30.0))
    np.testing.assert_allclose((left @ foot)[:3], [4.9, 2.0 - 0.41, height], atol=1e-12)
    np.testing.assert_allclose((right @ foot)[:3], [5.1, 2.0 + 0.41, height], atol=1e-12)


@pytest.mark.parametrize(("swing", "size"), [(0.0, 1.0), (0.38, 1.0), (-0.38, 0.7)])
def test_people_stand_on_the_ground_and_fill_no_more_than_the_cylinder(swing, size):
    poses = np.array([[0.0, 0.0, 0.0, swing]])
    places = pedestrians.world_from_parts(poses, np.array([size]))
    parts = zip(person_meshes(0, size), places, strict=True)
    points = np.concatenate(
        [mesh.triangles[0].reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3] for mesh, pose in parts]
    )
    assert len(pedestrians.PARTS) == 3
    assert -0.05 < points[:, 2].min() < 0.1
    assert points[:, 2].max() == pytest.approx(1.75 * size)
    assert np.abs(points[:, 1]).max() < 0.35 * size


CROSSROADS = Path(__file__).parent / "crossroads.yaml"
CORNER = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0)])


def test_lanes_are_refused_where_a_stretch_is_lost_or_a_walk_comes_back_beside_itself():
    # A right angle takes a metre of either stretch for each metre to the left; the second has 3.
    assert pedestrians.keeps_its_stretches(CORNER, 2.9)
    assert not pedestrians.keeps_its_stretches(CORNER, 3.1)
    assert pedestrians.keeps_its_stretches(CORNER, -9.0)
    hairpin = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 2.0), (0.0, 2.0)])
    # The two ways are 2 m apart: room for 0.3 m beside the outermost of lanes 1.3 m wide together.
    assert pedestrians.keeps_lanes_apart(hairpin, 1.3, 1.0)
    assert not pedestrians.keeps_lanes_apart(hairpin, 1.5, 1.0)
    assert pedestrians.keeps_lanes_apart(hairpin, 1.5, 0.7)
    crossing = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 6.0), (5.0, 6.0), (5.0, -6.0)])
    assert not pedestrians.keeps_lanes_apart(crossing, 0.7, 1.0)


def test_lanes_are_drawn_evenly_from_all_that_are_wide_enough():
    rng = np.random.default_rng(0)
    draws = np.array([pedestrians.draw_lanes(2, 1.61, 1.0, rng) for _ in range(4000)])
    gaps = np.abs(draws[:, 0] - draws[:, 1])
    assert gaps.min() >= 0.61 - 1e-12
    assert np.abs(draws).max() <= 1.61 / 2
    # One metre is free: of two even draws from it, a quarter are more than half of it apart.
    assert (gaps > 1.11).mean() == pytest.approx(0.25, abs=0.03)
    assert (draws[:, 0] > draws[:, 1]).mean() == pytest.approx(0.5, abs=0.03)
    assert draws.mean(axis=0) == pytest.approx(0.0, abs=0.03)
    np.testing.assert_allclose(
        np.sort(pedestrians.draw_lanes(3, 1.22, 1.0, rng)), [-0.61, 0.0, 0.61], atol=1e-9
    )


def least_distance(scene, speed_mps, episodes):
    """Returns how near two people of a scene come, looked at 24 times a second."""
    layout, least = Layout(scene), np.inf
    times = np.arange(0.0, scene.time_limit_s, 1 / 24)[:, None]
    for episode in range(episodes):
        rng = np.random.default_rng(episode)
        places = pedestrians.draw_crowd(layout, speed_mps, rng).positions(times)
        one, other = np.triu_indices(places.shape[1], 1)
        gaps = places[:, one] - places[:, other]
        least = min(least, np.hypot(gaps[..., 0], gaps[..., 1]).min())
    return least


@pytest.mark.parametrize("speed_mps", [(1.2, 1.8), (0.0, 5.0)])
@pytest.mark.parametrize("name", [*scene_names(), CROSSROADS])
def test_people_never_overlap(name, speed_mps):
    assert least_distance(load_scene(name), speed_mps, episodes=15) >= 0.6


def test_people_of_various_sizes_keep_apart_as_the_largest():
    mixed = load_scene(replace(load_scene("s_turn"), pedestrian_size=(0.5, 1.5)))
    sizes = mixed.pedestrian_sizes
    assert 0.5 <= sizes.min() < 0.6
    assert 1.4 < sizes.max() <= 1.5
    # The first two are 0.618 and 0.236 of the way.
    np.testing.assert_allclose(sizes[:2], [1.118, 0.736], atol=1e-3)
    assert least_distance(mixed, (1.2, 1.8), episodes=15) >= 0.9
    with pytest.raises(SceneError, match="spread_m: is"):
        load_scene(replace(mixed, pedestrian_size=3.0))


@pytest.mark.parametrize("draw", ["group", "pedestrian"])
@pytest.mark.parametrize(
    "walk",
    [
        # Round the bend of the S, on its inside, and across it where it bends.
        Walk("along", road="bends", from_m=35.0, to_m=85.0, offset_m=3.0),
        Walk("across", road="bends", at_m=59.0),
        Walk("points", points_m=((5.0, 2.0), (20.0, 3.0), (20.0, -3.0), (30.0, -3.0))),
    ],
)
def test_lanes_hold_round_every_kind_of_bend(walk, draw):
    group = PedestrianGroup("all", 4, 1.9, walk, standing=1, draw=draw)
    scene = replace(load_scene("s_turn"), pedestrian_groups=(group,), building_rows=())
    assert least_distance(load_scene(scene), (0.5, 3.0), episodes=10) >= 0.6
