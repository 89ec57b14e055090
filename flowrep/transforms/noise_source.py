"""The depth and camera motion that representations read, exact or with sensor noise."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

from tensordict.utils import NestedKey
from torchrl.envs.transforms import Transform

from flowrep.transforms.base import unknown_name
from flowrep.transforms.sensor_noise import SensorNoise

NOISE_OPTIONS = ("depth_sigma_per_m", "depth_dropout", "drift_m", "drift_rad")
NOISY_DEPTH_KEY = ("sensor", "noisy_depth")
NOISY_MOTION_KEY = ("sensor", "noisy_motion")

_FRAME_KEY = ("sensor", "frame")
_OF_DEPTH, _OF_MOTION = NOISE_OPTIONS[:2], NOISE_OPTIONS[2:]
_READ_DEPTH = {"depth", "depth2", "ego", "obj"}  # raw flow is not measured by a depth camera
_READ_MOTION = {"ego", "obj"}


class Sensed(NamedTuple):
    """The keys under which representations read depth and the camera's motion."""

    depth: NestedKey = ("sensor", "depth")
    motion: NestedKey = ("sensor", "prev_from_curr")


def noise_makers(
    noise: Mapping[str, float] | None, representations: Collection[str]
) -> tuple[list[Transform], Sensed]:
    """Returns one `SensorNoise`, if a representation reads a noisy sensor, and the keys to read.

    The exact values keep their keys, so that raw flow and a second pass over the same frames start
    from them. A frame's noise depends only on its name.

    Raises:
        ValueError: for an unknown option or an invalid value.
    """
    given: dict[str, Any] = dict(noise or {})
    for option in given:
        if option not in NOISE_OPTIONS:
            raise ValueError(unknown_name("option of noise:", option, NOISE_OPTIONS))
    SensorNoise(**given)  # checks all values, used or not
    sensed = Sensed()
    out_keys: dict[str, NestedKey] = {}
    used: dict[str, Any] = {}
    if not _READ_DEPTH.isdisjoint(representations) and any(map(given.get, _OF_DEPTH)):
        out_keys["depth"], sensed = NOISY_DEPTH_KEY, sensed._replace(depth=NOISY_DEPTH_KEY)
        used |= {name: given.get(name, 0.0) for name in _OF_DEPTH}
    if not _READ_MOTION.isdisjoint(representations) and any(map(given.get, _OF_MOTION)):
        out_keys["motion"], sensed = NOISY_MOTION_KEY, sensed._replace(motion=NOISY_MOTION_KEY)
        used |= {name: given.get(name, 0.0) for name in _OF_MOTION}
    if not used:
        return [], sensed
    maker = SensorNoise(
        sensors=list(out_keys), **used, frame_key=_FRAME_KEY, out_keys=list(out_keys.values())
    )
    maker.label = " and ".join(name for name in representations if name in _READ_DEPTH)
    return [maker], sensed
