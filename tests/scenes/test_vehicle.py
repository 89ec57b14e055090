"""The vehicle's motion against circles and rectangles drawn by hand."""

import math

import numpy as np
import pytest

from flowrep.scenes.scene import VehicleConfig
from flowrep.scenes.vehicle import YAW_SIGN, VehicleState, footprint_corners, roll, turn

NO_OP, TURN_LEFT, TURN_RIGHT = 0, 1, 2
CAR = VehicleConfig(4.0, 2.0, 1.4, 10.0, 30.0, 40.0)
STATE = VehicleState(1.0, 2.0, 0.5, 0.1)


def test_turning_changes_the_yaw_rate_by_alpha_times_dt_up_to_a_limit():
    # 30°/s² for half a second: 15°/s, counter-clockwise to the left.
    step = math.radians(15.0)
    assert turn(STATE, YAW_SIGN[TURN_LEFT], 0.5, CAR) == pytest.approx((1.0, 2.0, 0.5, 0.1 + step))
    assert turn(STATE, YAW_SIGN[TURN_RIGHT], 0.5, CAR) == pytest.approx((1.0, 2.0, 0.5, 0.1 - step))
    assert turn(STATE, YAW_SIGN[NO_OP], 0.5, CAR) == STATE
    # for 2 s would be 60°/s; the limit is 40
    left, right = (turn(STATE, YAW_SIGN[action], 2.0, CAR) for action in (TURN_LEFT, TURN_RIGHT))
    limit = math.radians(40.0)
    assert (left.yaw_rate_rps, right.yaw_rate_rps) == pytest.approx((limit, -limit))


def test_a_turning_vehicle_stays_on_its_circle():
    # 10 m/s at 0.5 rad/s is a radius of 20 m; a quarter to the left from (0, 0) ends at (20, 20).
    quarter = math.pi / 2 / 0.5
    end = roll(VehicleState(0.0, 0.0, 0.0, 0.5), quarter, 10.0)
    assert end == pytest.approx((20.0, 20.0, math.pi / 2, 0.5))
    right = roll(VehicleState(0.0, 0.0, 0.0, -0.5), quarter, 10.0)
    assert right == pytest.approx((20.0, -20.0, -math.pi / 2, -0.5))
    # On the way to (20, 20): 20 m times (sin 45°, 1 - cos 45°).
    half = roll(VehicleState(0.0, 0.0, 0.0, 0.5), quarter / 2, 10.0)
    assert half == pytest.approx((14.142, 5.858, math.pi / 4, 0.5), abs=1e-3)
    # At rest nothing changes, not even by rounding.
    state = VehicleState(0.1, 0.2, 0.3, 0.0)
    assert roll(state, 1 / 24, 0.0) == state


def test_arrays_of_states_are_driven_like_single_states():
    both = (STATE, VehicleState(-1.0, 7.0, 3.0, 0.0), VehicleState(0.0, 0.0, 0.0, -0.6))
    actions = [NO_OP, TURN_LEFT, TURN_RIGHT]
    states = VehicleState(*(np.array(field) for field in zip(*both)))
    turned = turn(states, np.array(YAW_SIGN)[actions], 0.5, CAR)
    rolled = roll(turned, 0.3, 10.0)
    for i, (state, action) in enumerate(zip(both, actions)):
        one = roll(turn(state, YAW_SIGN[action], 0.5, CAR), 0.3, 10.0)
        assert [field[i] for field in rolled] == pytest.approx(one)


def test_footprint_corners_are_front_left_first_and_counter_clockwise():
    # 4 m long and 2 m wide, facing +y: front left is at (-1, +2) from the centre.
    state = VehicleState(10.0, 20.0, math.pi / 2, 0.0)
    expected = [(9, 22), (9, 18), (11, 18), (11, 22)]
    np.testing.assert_allclose(footprint_corners(state, CAR), expected, atol=1e-12)
    wider = footprint_corners(state, CAR, 0.5)
    np.testing.assert_allclose(wider[0], (8.5, 22.5), atol=1e-12)
