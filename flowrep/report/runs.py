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


class Run:
    """A run's config and tables, and what a report asks for of them.

    Args:
        name: its folder, or its name in packed tables.
        config: the resolved config that it was started with.
        episodes: the columns of evaluation.csv; `path` counts the scene's paths.
        metrics: the columns of metrics.csv, nan where a cell is empty.
        folder: where films and drives may lie; None for a run of packed tables.
        machine: the commit, precision and CPU that trained it, "unknown" where not recorded.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the config is not what a run leaves.
    """

    def __init__(
        self,
        name: str,
        config: Mapping[str, Any],
        episodes: Columns,
        metrics: Columns,
        folder: Path | None = None,
        machine: Mapping[str, str] | None = None,
    ) -> None:
        self.name, self.config, self.folder = name, config, folder
        self.metrics, self.machine = metrics, machine or {}
        scene = config["scene"]
        self.scene: str = scene["name"]
        self.stack = stack_of(config["representations"])
        self.seed = int(config["seed"])
        self.speed: str = config["speed"]  # of the pedestrians in training
        self.fps = float(scene["frame_rate_hz"])
        self.total_frames = int(config["total_frames"])
        self.paths = max(len(scene.get("paths") or ()), 1)
        if not (isinstance(self.scene, str) and isinstance(self.speed, str)):
            raise TypeError("a name is none")
        columns = (metrics.get("frames", np.zeros(0)), episodes["frames"])
        self.frames = max((int(c.max()) for c in columns if len(c)), default=0)
        self.is_finished = self.frames >= self.total_frames
        self.settings = _settings(config)
        drawn = drawn_paths(episodes["episode_seed"], self.paths)
        self.episodes = episodes | {"path": drawn}

    @cached_property
    def tested(self) -> NDArray[np.bool_]:
        """Whether each episode is of the finished agent in its own scene, after training."""
        e = self.episodes
        is_own = e["scene"] == self.scene
        while_training = e["scene_id"][is_own & (e["evaluation"] != "evaluate")]
        if len(while_training):  # the scene may have been changed under the same name since
            is_own &= e["scene_id"] == while_training[0]
        return is_own & (e["evaluation"] != "training") & (e["frames"] >= self.total_frames)

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


def _settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what determines a run's weights, by dotted key, without the seed.

    Keys of one scene alone are under the scene's name, and options of a representation under its
    name: only runs that have the scene or the representation can differ in them.
    """
    parts = origin_of(config) | {"total_frames": config["total_frames"]}
    del parts["flowrep"], parts["seed"]
    scene = parts.pop("scene")
    own = {key: value for key, value in scene.items() if key not in _OF_EVERY_SCENE}
    shared = {f"scene.{key}": scene[key] for key in _OF_EVERY_SCENE if key in scene}
    found = dict([*_flat(parts | shared), *_flat(own, f"scene.{scene['name']}")])
    return {k: v for k, v in found.items() if v != {}}  # a representation without options


def drawn_paths(episode_seeds: NDArray[Any], paths: int) -> NDArray[Any]:
    """Returns the path of each episode: the first draw of its generator, as an episode makes it."""
    if paths < 2:
        return np.zeros(len(episode_seeds), int)
    seeds, places = np.unique(episode_seeds, return_inverse=True)
    drawn = [int(np.random.default_rng(int(seed)).integers(paths)) for seed in seeds]
    return np.array(drawn, int)[places]


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
