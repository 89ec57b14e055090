"""Runs as a report sees them: config, columns of episodes and of metrics, and groups of runs."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.experiment.run import origin_of

Columns = dict[str, NDArray[Any]]
SPEEDS = ("low", "normal", "high")
"""Pedestrians' speed modes, in the order of figures."""
SCENES = ("straight_road", "s_turn", "h_shaped_pathways", "three_way_junction")
"""The paper's scenes in its order."""
_ORDER = ("raw", "ego", "obj", "seg", "seg2", "depth", "depth2", "rgb")
_OF_EVERY_SCENE = ("camera", "frame_rate_hz")


class Condition(NamedTuple):
    """How agents were evaluated: policy, pedestrians' speed mode, frames per second."""

    policy: str
    speed: str
    fps: float


@dataclass(frozen=True, eq=False)
class Run:
    """A run's config and tables.

    Args:
        name: its folder, or its name in packed tables.
        config: the resolved config that it was started with.
        episodes: the columns of evaluation.csv, see `EPISODE_COLUMNS`.
        metrics: the columns of metrics.csv, nan where a cell is empty.
        folder: where films and drives may lie; None for a run of packed tables.
        machine: the commit, precision and CPU that trained it, "unknown" where not recorded.
    """

    name: str
    config: Mapping[str, Any]
    episodes: Columns
    metrics: Columns
    folder: Path | None = None
    machine: Mapping[str, str] | None = None

    @cached_property
    def settings(self) -> dict[str, Any]:
        """What determines its weights, by dotted key, without the seed.

        Keys of one scene alone are under the scene's name, and options of a representation under
        its name: only runs that have the scene or the representation can differ in them.
        """
        parts = origin_of(self.config)
        del parts["flowrep"], parts["seed"]
        scene = parts.pop("scene")
        own = {key: value for key, value in scene.items() if key not in _OF_EVERY_SCENE}
        shared = {f"scene.{key}": scene[key] for key in _OF_EVERY_SCENE if key in scene}
        found = dict([*_flat(parts | shared), *_flat(own, f"scene.{self.scene}")])
        return {k: v for k, v in found.items() if v != {}}  # a representation without options

    @property
    def scene(self) -> str:
        """The name of the scene that it was trained in."""
        return self.config["scene"]["name"]

    @property
    def stack(self) -> str:
        """What the agent sees, e.g. `ego+obj`, in a fixed order."""
        return stack_of(self.config["representations"])

    @property
    def seed(self) -> int:
        """The seed of the training."""
        return self.config["seed"]

    @property
    def speed(self) -> str:
        """The pedestrians' speed mode in training."""
        return self.config["speed"]

    @property
    def fps(self) -> float:
        """The frame rate in training, in Hz."""
        return float(self.config["scene"]["frame_rate_hz"])

    @property
    def total_frames(self) -> int:
        """The frames that it should be trained for."""
        return self.config["total_frames"]

    @property
    def paths(self) -> Sequence[str]:
        """The names of the scene's paths; an episode's column `path` counts them."""
        return [path["name"] for path in self.config["scene"].get("paths", [{"name": ""}])]

    @cached_property
    def frames(self) -> int:
        """The frames that it has been trained for, from its tables."""
        columns = (self.metrics.get("frames"), self.episodes["frames"])
        return max((int(c.max()) for c in columns if c is not None and len(c)), default=0)

    @property
    def is_finished(self) -> bool:
        """Returns whether it was trained for `total_frames`."""
        return self.frames >= self.total_frames

    @cached_property
    def tested(self) -> NDArray[np.bool_]:
        """Whether each episode is of the finished agent in its own scene, after training."""
        e = self.episodes
        is_after = (e["evaluation"] != "training") & (e["frames"] >= self.total_frames)
        return is_after & (e["scene"] == self.scene)

    @cached_property
    def conditions(self) -> set[Condition]:
        """The conditions of its tested episodes."""
        columns = (self.episodes[name][self.tested].tolist() for name in Condition._fields)
        return {Condition(*cells) for cells in zip(*columns)}

    def under(self, condition: Condition) -> Columns:
        """Returns the tested episodes of a condition."""
        e = self.episodes
        asked = zip(Condition._fields, condition)
        chosen = np.logical_and.reduce([self.tested, *(e[name] == v for name, v in asked)])
        return {name: column[chosen] for name, column in e.items()}


def stack_of(representations: Iterable[str]) -> str:
    """Returns the name of a set of representations, in any order.

    >>> stack_of(["seg2", "obj", "ego"]), stack_of(["raw"])
    ('ego+obj+seg2', 'raw')
    """
    names = list(representations)
    known = [name for name in _ORDER if name in names]
    return "+".join([*known, *sorted(set(names) - set(known))])


def in_order(found: Iterable[str], known: Sequence[str]) -> list[str]:
    """Returns the found names without repeats, the known ones first and in their order."""
    names = set(found)
    return [name for name in known if name in names] + sorted(names - set(known))


def scenes_of(runs: Sequence[Run]) -> list[str]:
    """Returns the scenes that runs were trained in, the paper's first."""
    return in_order([run.scene for run in runs], SCENES)


@dataclass(frozen=True)
class Group:
    """Runs that may be compared: they differ in scene, representations and seed alone.

    Args:
        runs: the group's runs.
        differences: the keys in which groups differ, with this one's values.
    """

    runs: tuple[Run, ...]
    differences: dict[str, Any]

    @property
    def label(self) -> str:
        """What distinguishes it from other groups; empty if it is the only one."""
        shown = [f"{key}={value}" for key, value in self.differences.items()]
        shown = [text if len(text) < 60 else f"{text[:56]} ..." for text in shown]
        more = [f"{len(shown) - 3} more keys"] if len(shown) > 4 else []
        return ", ".join(shown[:3] + more if more else shown)


def groups_of(runs: Sequence[Run]) -> list[Group]:
    """Returns runs grouped by the settings in which they differ, the largest group first."""
    values: dict[str, dict[str, Any]] = {}
    for key in dict.fromkeys(key for run in runs for key in run.settings):
        of_runs = [run.settings.get(key, "absent") for run in runs if _can_have(run, key)]
        values[key] = {repr(value): value for value in of_runs}
    differing = [key for key, found in values.items() if len(found) > 1]
    groups: dict[tuple[tuple[str, str], ...], list[Run]] = {}
    for run in runs:
        own = {k: run.settings.get(k, "absent") for k in differing if _can_have(run, k)}
        groups.setdefault(tuple((k, repr(v)) for k, v in own.items()), []).append(run)
    found = [Group(tuple(g), {k: values[k][v] for k, v in key}) for key, g in groups.items()]
    return sorted(found, key=lambda group: -len(group.runs))


def _can_have(run: Run, key: str) -> bool:
    place, _, rest = key.partition(".")
    part = rest.split(".")[0]
    if place == "representations":
        return part in run.config[place]
    return place != "scene" or part in (*_OF_EVERY_SCENE, run.scene)


def _flat(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _flat(inner, f"{place}.{key}" if place else str(key))
    else:
        yield place, _plain(value)


def _plain(value: Any) -> Any:
    """Returns a value that is spelt in one way: 4.0 in a file is 4 on a command line."""
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
