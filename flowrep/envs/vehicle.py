"""The vehicle: constant speed, three actions that change its yaw rate, a rectangular footprint."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

NO_OP, TURN_LEFT, TURN_RIGHT = 0, 1, 2
YAW_SIGN = np.array([0.0, 1.0, -1.0])  # by action; left is counter-clockwise


@dataclass(frozen=True)
class VehicleConfig:
    """Footprint, speed and turning of the vehicle."""

    length_m: float
    width_m: float
    height_m: float
    speed_mps: float
    yaw_acceleration_dps2: float
    max_yaw_rate_dps: float


class VehicleState(NamedTuple):
    """Pose of the footprint's centre and yaw rate; scalars, or arrays of one shape."""

    x_m: Any
    y_m: Any
    yaw_rad: Any
    yaw_rate_rps: Any


def turn(state: VehicleState, action: Any, dt_s: float, vehicle: VehicleConfig) -> VehicleState:
    """Returns the state with its yaw rate changed by the action: plus or minus α·Δt, or nothing."""
    limit = math.radians(vehicle.max_yaw_rate_dps)
    step = math.radians(vehicle.yaw_acceleration_dps2) * dt_s
    rate = state.yaw_rate_rps + YAW_SIGN[action] * step
    return state._replace(yaw_rate_rps=np.minimum(np.maximum(rate, -limit), limit))


def roll(state: VehicleState, dt_s: Any, speed_mps: float) -> VehicleState:
    """Returns the state after `dt_s` on the circular arc of its yaw rate, exactly."""
    angle = state.yaw_rate_rps * dt_s
    half = 0.5 * angle
    # The chord of an arc of length d and angle a is d·sin(a/2)/(a/2), along the mean heading. An
    # angle this small stands for none: the quotient is 1 for it.
    half_or_tiny = np.where(half == 0.0, 1e-20, half)
    chord = speed_mps * dt_s * (np.sin(half_or_tiny) / half_or_tiny)
    heading = state.yaw_rad + half
    return VehicleState(
        state.x_m + chord * np.cos(heading),
        state.y_m + chord * np.sin(heading),
        state.yaw_rad + angle,
        state.yaw_rate_rps,
    )


def footprint_corners(
    state: VehicleState, vehicle: VehicleConfig, margin_m: float = 0.0
) -> NDArray[np.float64]:
    """Returns the footprint's corners [..., 4, 2], counter-clockwise, widened by `margin_m`."""
    half_length = vehicle.length_m / 2 + margin_m
    half_width = vehicle.width_m / 2 + margin_m
    forward = half_length * np.array([1.0, -1.0, -1.0, 1.0])
    left = half_width * np.array([1.0, 1.0, -1.0, -1.0])
    sine, cosine = np.sin(state.yaw_rad)[..., None], np.cos(state.yaw_rad)[..., None]
    x = np.asarray(state.x_m)[..., None] + cosine * forward - sine * left
    y = np.asarray(state.y_m)[..., None] + sine * forward + cosine * left
    return np.stack([x, y], axis=-1)
