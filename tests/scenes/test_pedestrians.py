"""Walks against a timetable worked by hand."""

import math

import numpy as np
import pytest

from flowrep.scenes.pedestrians import Crowd

# A walks 10 m along x at 1 m/s; B a corner of 4 m along y and 3 m along x at 2 m/s; C stands.
LINES = [
    np.array([(0.0, 0.0), (10.0, 0.0)]),
    np.array([(1.0, 1.0), (1.0, 5.0), (4.0, 5.0)]),
    np.array([(0.0, 2.0), (0.0, 4.0)]),
]


@pytest.fixture
def crowd():
    # C's phase is a quarter of the way there and back: half-way there.
    return Crowd(LINES, np.array([1.0, 2.0, 0.0]), np.array([0.0, 0.0, 0.25]))


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
def test_everyone_is_where_the_timetable_says(crowd, time_s, expected):
    np.testing.assert_allclose(crowd.positions(time_s), expected, atol=1e-12)
    np.testing.assert_allclose(crowd.poses(time_s)[:, :2], expected, atol=1e-12)


def test_people_look_where_they_walk_and_turn_about_at_the_ends(crowd):
    def looks(time_s, person):
        return crowd.poses(time_s)[person, 2] % (2 * math.pi)

    assert looks(5.0, 0) == pytest.approx(0.0)
    assert looks(15.0, 0) == pytest.approx(math.pi)
    assert looks(10.0, 0) == pytest.approx(math.pi / 2)  # in the middle of turning about
    assert looks(1.0, 1) == pytest.approx(math.pi / 2)  # +y
    assert looks(2.8, 1) == pytest.approx(0.0)  # +x, round the corner


def test_no_one_turns_faster_than_half_a_turn_in_its_time(crowd):
    times = np.arange(0.0, 41.0, 0.01)
    looks = np.unwrap([crowd.poses(time_s)[0, 2] for time_s in times])
    assert np.abs(np.diff(looks)).max() <= math.pi / 0.6 * 0.01 + 1e-9


def test_one_who_stands_keeps_the_very_same_pose(crowd):
    first = crowd.poses(0.0)[2]
    for time_s in (0.1, 1 / 3, 7.7):
        assert np.array_equal(crowd.poses(time_s)[2], first)


def test_many_times_at_once_are_many_calls(crowd):
    times = np.array([0.0, 0.7, 3.3, 12.1])
    together = crowd.positions(times[:, None])
    assert together.shape == (4, 3, 2)
    for time_s, places in zip(times, together):
        np.testing.assert_array_equal(places, crowd.positions(time_s))
    for time_s, poses in zip(times, crowd.poses(times[:, None])):
        np.testing.assert_array_equal(poses, crowd.poses(time_s))


def test_a_scene_may_be_without_people():
    empty = Crowd([], np.zeros(0), np.zeros(0))
    assert len(empty) == 0
    assert empty.poses(1.0).shape == (0, 4)
    assert empty.positions(np.ones((2, 1))).shape == (2, 0, 2)


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
