"""The vehicle: its state, actions, motion and footprint.

Convention: world metres, x forward at yaw 0, yaw and yaw rate counter-clockwise in radians. States
hold scalars, or arrays of one shape, so that the planner can drive many vehicles at once.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.scenes.scene import VehicleConfig

NO_OP, TURN_LEFT, TURN_RIGHT = 0, 1, 2
YAW_SIGN = (0.0, 1.0, -1.0)  # by action, which films name; left is counter-clockwise


class VehicleState(NamedTuple):
    """Pose of the footprint's centre, and the yaw rate in rad/s."""

    x_m: Any
    y_m: Any
    yaw_rad: Any
    yaw_rate_rps: Any


def turn(state: VehicleState, sign: Any, dt_s: float, vehicle: VehicleConfig) -> VehicleState:
    """Returns the state with its yaw rate changed by α·Δt times an action's `YAW_SIGN`."""
    limit = math.radians(vehicle.max_yaw_rate_dps)
    rate = state.yaw_rate_rps + sign * (math.radians(vehicle.yaw_acceleration_dps2) * dt_s)
    is_array = isinstance(rate, np.ndarray)
    rate = np.clip(rate, -limit, limit) if is_array else min(max(rate, -limit), limit)
    return state._replace(yaw_rate_rps=rate)


def roll(state: VehicleState, dt_s: float, speed_mps: float) -> VehicleState:
    """Returns the exact state after driving for `dt_s` along the arc of its yaw rate."""
    xp: Any = np if isinstance(state.yaw_rate_rps, np.ndarray) else math
    angle = state.yaw_rate_rps * dt_s
    # An arc of length d and angle a has a chord of length d·sin(a/2)/(a/2) along the mean heading.
    # A tiny angle replaces 0, so that the quotient is 1 then.
    half = 0.5 * angle
    half_or_tiny = half + (half == 0.0) * 1e-20
    chord = speed_mps * dt_s * (xp.sin(half_or_tiny) / half_or_tiny)
    heading = state.yaw_rad + half
    x_m, y_m = state.x_m + chord * xp.cos(heading), state.y_m + chord * xp.sin(heading)
    return VehicleState(x_m, y_m, state.yaw_rad + angle, state.yaw_rate_rps)


def footprint_corners(
    state: VehicleState, vehicle: VehicleConfig, margin_m: float = 0.0
) -> NDArray[np.float64]:
    """Returns the footprint's corners [..., 4, 2], counter-clockwise, widened by `margin_m`."""
    forward = (vehicle.length_m / 2 + margin_m) * np.array([1.0, -1.0, -1.0, 1.0])
    left = (vehicle.width_m / 2 + margin_m) * np.array([1.0, 1.0, -1.0, -1.0])
    sine, cosine = np.sin(state.yaw_rad)[..., None], np.cos(state.yaw_rad)[..., None]
    x = np.asarray(state.x_m)[..., None] + cosine * forward - sine * left
    y = np.asarray(state.y_m)[..., None] + sine * forward + cosine * left
    return np.stack([x, y], axis=-1)
