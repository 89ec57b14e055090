"""The identity of a checkpoint's run, so that it is not loaded into another."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from flowrep import __version__
from flowrep.agent import CheckpointError

_IDENTITY = (
    "scene",
    "representations",
    "flow",
    "noise",
    "algorithm",
    "speed",
    "seed",
    "num_envs",
    "total_frames",
)
"""The parts of a config that determine the weights."""

_ABSENT = "absent"


def origin_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the identity of a run: flowrep's version, and the config keys that define it."""
    parts = {key: config[key] for key in _IDENTITY}
    return {"flowrep": __version__} | json.loads(json.dumps(parts))


def check_origin(saved: Mapping[str, Any], expected: Mapping[str, Any], path: Path) -> None:
    """Checks that a checkpoint belongs to a run.

    Args:
        saved: the origin stored in the checkpoint.
        expected: the origin of the config in its folder.
        path: the checkpoint, for the message.

    Raises:
        CheckpointError: if it belongs to another; names the first difference.
    """
    if saved.get("flowrep") != expected["flowrep"]:
        raise CheckpointError(
            f"{path} was written by flowrep {saved.get('flowrep')}, this is {expected['flowrep']}: "
            "install that version, or start a new run"
        )
    for place, there, here in differences(saved, expected):
        raise CheckpointError(
            f"{path} belongs to a run with {place}={there}, the config.yaml of its folder says "
            f"{place}={here}: restore the file that was there, or start a new run"
        )


def differences(saved: Any, expected: Any, place: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yields the dotted key of each difference with the two values."""
    if not (isinstance(saved, Mapping) and isinstance(expected, Mapping)):
        if saved != expected:
            yield place, saved, expected
        return
    for key in dict.fromkeys([*saved, *expected]):
        there, here = saved.get(key, _ABSENT), expected.get(key, _ABSENT)
        yield from differences(there, here, f"{place}.{key}" if place else key)
