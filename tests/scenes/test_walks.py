"""People never stand in each other: lanes by hand, how they are drawn, and whole episodes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowrep.scenes import SceneError, load_scene, scene_names
from flowrep.scenes.layout import Layout, parallel, without_repeats
from flowrep.scenes.pedestrians import (
    draw_crowd,
    draw_lanes,
    keeps_its_stretches,
    keeps_lanes_apart,
)
from flowrep.scenes.scene import PedestrianGroup, Walk

CROSSROADS = Path(__file__).parent / "crossroads.yaml"
CORNER = np.array([(0.0, 0.0), (4.0, 0.0), (4.0, 3.0)])


def test_a_line_moved_aside_is_parallel_stretch_by_stretch():
    # The left of +x is +y, of +y it is -x.
    np.testing.assert_allclose(parallel(CORNER, 1.0), [(0, 1), (3, 1), (3, 3)])
    np.testing.assert_allclose(parallel(CORNER, -1.0), [(0, -1), (5, -1), (5, 3)])
    np.testing.assert_array_equal(parallel(CORNER, 0.0), CORNER)


def test_points_on_top_of_each_other_are_one():
    repeated = np.array([(0.0, 0.0), (0.0, 1e-5), (4.0, 0.0), (4.0, 0.0), (4.0, 3.0)])
    np.testing.assert_array_equal(without_repeats(repeated), CORNER)


def test_a_stretch_is_lost_where_a_line_is_moved_further_inwards_than_it_is_long():
    # A right angle takes a metre of either stretch for each metre to the left; the second has 3.
    assert keeps_its_stretches(CORNER, 2.9)
    assert not keeps_its_stretches(CORNER, 3.1)
    assert keeps_its_stretches(CORNER, -9.0)


def test_lanes_are_refused_where_a_walk_comes_back_beside_itself():
    hairpin = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 2.0), (0.0, 2.0)])
    # The two ways are 2 m apart: room for 0.3 m beside the outermost of lanes 1.3 m wide together.
    assert keeps_lanes_apart(hairpin, 1.3)
    assert not keeps_lanes_apart(hairpin, 1.5)
    crossing = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 6.0), (5.0, 6.0), (5.0, -6.0)])
    assert not keeps_lanes_apart(crossing, 0.7)


def test_lanes_are_drawn_evenly_from_all_that_are_wide_enough():
    rng = np.random.default_rng(0)
    draws = np.array([draw_lanes(2, 1.61, rng) for _ in range(4000)])
    gaps = np.abs(draws[:, 0] - draws[:, 1])
    assert gaps.min() >= 0.61 - 1e-12
    assert np.abs(draws).max() <= 1.61 / 2
    # One metre is free: of two even draws from it, a quarter are more than half of it apart.
    assert (gaps > 1.11).mean() == pytest.approx(0.25, abs=0.03)
    assert (draws[:, 0] > draws[:, 1]).mean() == pytest.approx(0.5, abs=0.03)
    assert draws.mean(axis=0) == pytest.approx(0.0, abs=0.03)
    np.testing.assert_allclose(np.sort(draw_lanes(3, 1.22, rng)), [-0.61, 0.0, 0.61], atol=1e-9)


def least_distance(scene, speed_mps, episodes):
    """Returns how near two people of a scene come, looked at 24 times a second."""
    layout, least = Layout(scene), np.inf
    times = np.arange(0.0, scene.time_limit_s, 1 / 24)[:, None]
    for episode in range(episodes):
        rng = np.random.default_rng(episode)
        places = draw_crowd(layout, scene.pedestrian_groups, speed_mps, rng).positions(times)
        one, other = np.triu_indices(places.shape[1], 1)
        gaps = places[:, one] - places[:, other]
        least = min(least, np.hypot(gaps[..., 0], gaps[..., 1]).min())
    return least


@pytest.mark.parametrize("speed", ["low", "normal", "high", (0.0, 5.0)])
@pytest.mark.parametrize("name", [*scene_names(), CROSSROADS])
def test_nobody_ever_stands_in_another(name, speed):
    scene = load_scene(name)
    speed_mps = scene.pedestrian_speed_mps[speed] if isinstance(speed, str) else speed
    assert least_distance(scene, speed_mps, episodes=20) >= 0.6


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
    assert least_distance(load_scene(scene), (0.5, 3.0), episodes=20) >= 0.6


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


def test_walks_that_just_keep_their_distance_are_taken(straight_road):
    # From 49.5 to 50.5 m along the road, and from 51.1 to 52.1.
    groups = [
        PedestrianGroup(name, 2, 1.0, Walk("across", road="main", at_m=at_m))
        for name, at_m in (("one", 50.0), ("two", 51.61))
    ]
    scene = load_scene(replace(straight_road, pedestrian_groups=tuple(groups)))
    assert least_distance(scene, (1.0, 2.0), episodes=5) >= 0.6
