"""What representations need of the environments whose sensors they read."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

from flowrep.envs.sensing import SENSORS


def sensors_read(transforms: Iterable[Any]) -> list[str]:
    """Returns the sensors that transforms read, in the order of `SENSORS`."""
    keys = {key for transform in transforms for key in transform.in_keys}
    return [name for name in SENSORS if ("sensor", name) in keys]


def check_rate(
    transforms: Iterable[Any], options: Mapping[str, Any] | None, frame_rate_hz: float
) -> None:
    """Checks that a reset's options leave the steps as long as flow in px/s takes them to be.

    Args:
        transforms: those that write the representations.
        options: of the reset, see `StreetEnv.reset`.
        frame_rate_hz: the rate for which the transforms were made.

    Raises:
        ValueError: flow is in px/s and the options ask for another rate.
    """
    asked = (options or {}).get("frame_rate_hz")
    if asked is None or not any(getattr(t, "is_per_second", False) for t in transforms):
        return
    if not math.isclose(float(asked), frame_rate_hz):
        raise ValueError(
            f"flow in px_per_s was set up for {frame_rate_hz:g} frames a second, and a reset can't "
            f"change that to {asked}: make another env, with frame_rate_hz={asked}"
        )
