"""Runs as a report sees them: their columns, which may be compared, and what episodes came to."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.experiment.run import origin_of
from flowrep.report.statistics import Array, Estimate, mean_share

Columns = dict[str, NDArray[Any]]
# of a run, from its episodes' outcomes under each condition
Score = Callable[[Sequence[NDArray[Any]]], float]
SPEEDS = ("low", "normal", "high")  # of pedestrians
# The paper's scenes and stacks, in the order of its figures.
SCENES = ("straight_road", "s_turn", "h_shaped_pathways", "three_way_junction")
FLOW_STACKS = ("ego", "raw", "obj", "ego+obj")
COMPLEMENTARY_STACKS = (
    "seg2", "depth2", "ego+obj", "ego+obj+seg2", "ego+obj+depth2", "ego+obj+seg2+depth2",
)  # fmt: skip
STACKS = tuple(dict.fromkeys(FLOW_STACKS + COMPLEMENTARY_STACKS))
BASELINES = ("never_turn", "random", "planner")
_REPRESENTATIONS = ("raw", "ego", "obj", "seg", "seg2", "depth", "depth2", "rgb")
_OF_EVERY_SCENE = ("camera", "frame_rate_hz")


class Condition(NamedTuple):
    """How agents were evaluated: policy, pedestrians' speed mode, frames per second."""

    policy: str
    speed: str
    fps: float


@dataclass(eq=False)
class Run:
    """A run's config and tables, and what a report asks for of them."""

    name: str  # its folder, or its name in packed tables
    config: Mapping[str, Any]
    episodes: Columns  # of evaluation.csv
    metrics: Columns  # of metrics.csv, nan where a cell is empty
    folder: Path | None = None  # where films and drives may lie
    machine: Mapping[str, str] = field(default_factory=dict)  # that trained it

    def __post_init__(self) -> None:
        config, scene = self.config, self.config["scene"]
        self.scene: str = scene["name"]
        self.stack = stack_of(config["representations"])
        self.seed = int(config["seed"])
        self.speed: str = config["speed"]  # of the pedestrians in training
        self.fps = float(scene["frame_rate_hz"])
        self.total_frames = int(config["total_frames"])
        columns = (self.metrics.get("frames", np.zeros(0)), self.episodes["frames"])
        self.frames = max((int(c.max()) for c in columns if len(c)), default=0)
        self.is_finished = self.frames >= self.total_frames
        self.settings = _settings(config)

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


def _settings(config: Mapping[str, Any]) -> dict[str, str]:
    # What determines a run's weights, by dotted key, without the seed. Keys of one scene alone are
    # under its name, as options of a representation are: only runs that have it differ in them.
    parts = origin_of(config) | {"total_frames": config["total_frames"]}
    del parts["flowrep"], parts["seed"]
    scene = parts.pop("scene")
    shared = {key: scene.pop(key) for key in _OF_EVERY_SCENE if key in scene}
    parts["scene"] = shared | {scene["name"]: scene}
    return {key: str(value) for key, value in _flat(parts) if value != {}}


def _flat(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _flat(inner, f"{place}.{key}" if place else str(key))
    else:
        yield place, _plain(value)


def _plain(value: Any) -> Any:
    # 4.0 in a file is 4 on a command line
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def in_order(found: Iterable[str], known: Sequence[str]) -> list[str]:
    """Returns the found names without repeats, the known ones first and in their order."""
    names = set(found)
    return [name for name in known if name in names] + sorted(names - set(known))


def stack_of(representations: Iterable[str]) -> str:
    """Returns the name of a set of representations, in any order."""
    return "+".join(in_order(representations, _REPRESENTATIONS))


def scenes_of(runs: Sequence[Run]) -> list[str]:
    """Returns the scenes that runs were trained in, the paper's first."""
    return in_order([run.scene for run in runs], SCENES)


def in_stacks(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Returns the runs of each of their stacks, the paper's first."""
    stacks = in_order([run.stack for run in runs], STACKS)
    return {stack: [run for run in runs if run.stack == stack] for stack in stacks}


class Group(NamedTuple):
    """Runs that may be compared, and the keys in which groups differ with this one's values."""

    runs: tuple[Run, ...]
    differences: dict[str, str]

    @property
    def label(self) -> str:
        """What distinguishes it from other groups; empty if it is the only one."""
        shown = [f"{key}={value}"[:60] for key, value in self.differences.items()]
        return ", ".join(shown if len(shown) < 5 else [*shown[:3], f"{len(shown) - 3} more keys"])


def groups_of(runs: Sequence[Run]) -> list[Group]:
    """Returns runs that differ in scene, representations and seed alone, largest groups first."""
    keys = dict.fromkeys(key for run in runs for key in run.settings)
    # a key that a run could have and doesn't is a difference, as when a later version added it
    own = [{k: run.settings.get(k, "absent") for k in keys if _can_have(run, k)} for run in runs]
    differing = [key for key in keys if len({of[key] for of in own if key in of}) > 1]
    groups: dict[tuple[tuple[str, str], ...], list[Run]] = {}
    for run, of in zip(runs, own):
        groups.setdefault(tuple((k, of[k]) for k in differing if k in of), []).append(run)
    found = [Group(tuple(members), dict(values)) for values, members in groups.items()]
    return sorted(found, key=lambda group: -len(group.runs))


def _can_have(run: Run, key: str) -> bool:
    place, _, rest = key.partition(".")
    part = rest.split(".")[0]
    if place == "representations":
        return part in run.config[place]
    return place != "scene" or part in (*_OF_EVERY_SCENE, run.scene)


def success_rate(outcomes: Sequence[NDArray[Any]]) -> float:
    """Returns the share of episodes that succeed."""
    return float((np.concatenate(outcomes) == "success").mean())


def departures(outcomes: Sequence[NDArray[Any]]) -> float:
    """Returns the share of departures from the road in them and collisions: the paper's Table III.

    It is nan without either.
    """
    ends = np.concatenate(outcomes)
    out, hit = (ends == "out_of_bounds").sum(), (ends == "collision").sum()
    return float(out / (out + hit)) if out + hit else float("nan")


def own_scores(
    runs: Iterable[Run], conditions: Sequence[Condition], score: Score = success_rate
) -> Array:
    """Returns the score of each run `[R]`, of all its episodes, by seed.

    Runs that lack a condition are left out, and those whose score is nan.
    """
    ours = [r for r in sorted(runs, key=lambda r: r.seed) if r.conditions.issuperset(conditions)]
    found = np.array([score([run.under(c)["outcome"] for c in conditions]) for run in ours])
    return found[~np.isnan(found)]


def paired_scores(
    sides: Sequence[Sequence[Run]], conditions: Sequence[Condition], score: Score = success_rate
) -> tuple[list[Array], int] | None:
    """Returns the score of each run of each side, of the episodes that all of them drove.

    An episode's difficulty is so no part of a difference. The number is that of those episodes;
    None if there are none. Runs that lack a condition are left out.
    """
    ours = [[run for run in side if run.conditions.issuperset(conditions)] for side in sides]
    if not all(ours):
        return None
    driven = [[[run.under(c) for c in conditions] for run in side] for side in ours]
    seeds = (columns["episode_seed"] for side in driven for found in side for columns in found)
    shared = reduce(np.intersect1d, seeds)
    if not len(shared):
        return None

    def scored(found: Sequence[Columns]) -> float:
        return score([c["outcome"][np.isin(c["episode_seed"], shared)] for c in found])

    return [np.array([scored(found) for found in side]) for side in driven], len(shared)


def changes(runs: Iterable[Run], before: Condition, after: Condition) -> Array:
    """Returns each run's change of success `[R]`, in the episodes that it drove under both."""

    def change(outcomes: Sequence[NDArray[Any]]) -> float:
        return success_rate(outcomes[1:]) - success_rate(outcomes[:1])

    found = [paired_scores([[run]], (before, after), change) for run in runs]
    return np.array([pair[0][0][0] for pair in found if pair])


def baseline_share(runs: Iterable[Run], condition: Condition) -> float | None:
    """Returns the success rate of a baseline, the condition's policy; None if it did not drive."""
    driven = [run.under(condition) for run in runs]
    seeds, outcomes = (
        np.concatenate([c[name] for c in driven]) for name in ("episode_seed", "outcome")
    )
    # its drive of an episode doesn't depend on the agent beside it: each episode counts once
    _, first = np.unique(seeds, return_index=True)
    return success_rate([outcomes[first]]) if len(first) else None


class Cell(NamedTuple):
    """The success of one series in one scene and condition."""

    rates: Array  # of its runs [R]
    counts: str  # the numbers of seeds and episodes, as text: `3 × 192`
    score: Estimate


class Grid(NamedTuple):
    """Success in one scene by series, which is a stack (of one config), and condition.

    A place without runs has no cell.
    """

    scene: str
    series: tuple[str, ...]
    conditions: tuple[Condition, ...]
    cells: Mapping[tuple[str, Condition], Cell]
    baselines: Mapping[tuple[str, Condition], float]


def cell_of(runs: Sequence[Run], condition: Condition) -> Cell | None:
    """Returns the success of runs of one scene; None if none drove under the condition."""
    lengths = [len(run.under(condition)["outcome"]) for run in runs]
    driven = [number for number in lengths if number]
    if not driven:
        return None
    rates, fewest, most = own_scores(runs, [condition]), min(driven), max(driven)
    counts = f"{len(rates)} × {fewest}" + (f"–{most}" if most > fewest else "")
    return Cell(rates, counts, mean_share([rates], fewest))


def grid_of(
    scene: str,
    series: Mapping[str, Sequence[Run]],
    conditions: Sequence[Condition],
    baselines: Sequence[str] = BASELINES,
) -> Grid:
    """Returns the success of several series of runs in a scene; those of others are left out."""
    here = {name: [run for run in runs if run.scene == scene] for name, runs in series.items()}
    cells = {
        (name, condition): cell
        for name, condition in product(series, conditions)
        if (cell := cell_of(here[name], condition)) is not None
    }
    everybody = [run for runs in here.values() for run in runs]
    shares = {
        (name, condition): share
        for name, condition in product(baselines, conditions)
        if (share := baseline_share(everybody, condition._replace(policy=name))) is not None
    }
    return Grid(scene, tuple(series), tuple(conditions), cells, shares)


class Curve(NamedTuple):
    """One run's (frames, share of success) in evaluations and in training episodes."""

    evaluated: list[tuple[int, float]]
    training: list[tuple[int, float]]


def curve_of(run: Run) -> Curve:
    """Returns greedy evaluations at the run's own speed and frame rate, and training episodes."""
    e = run.episodes
    own = (e["scene"] == run.scene) & (e["speed"] == run.speed) & (e["fps"] == run.fps)
    own &= e["policy"] == "greedy"
    evaluated: dict[int, float] = {}
    for kind in ("training", "final"):  # at the final frames that one alone: other episodes
        chosen = own & (e["evaluation"] == kind)
        frames, outcomes = e["frames"][chosen], e["outcome"][chosen]
        at = np.unique(frames).tolist()
        evaluated |= {f: success_rate([outcomes[frames == f]]) for f in at}
    logged = zip(run.metrics.get("frames", ()), run.metrics.get("success", ()))
    training = [(int(frames), float(share)) for frames, share in logged if not np.isnan(share)]
    return Curve(sorted(evaluated.items()), training)


def mean_curve(curves: Sequence[Sequence[tuple[int, float]]]) -> list[tuple[int, float]]:
    """Returns the mean over curves, at the frames that most of them have.

    >>> mean_curve([[(10, 0.0), (20, 0.5)], [(10, 1.0), (20, 1.0)], [(10, 0.5)]])
    [(10, 0.5), (20, 0.75)]
    """
    at: dict[int, list[float]] = {}
    for frames, share in (point for curve in curves for point in curve):
        at.setdefault(frames, []).append(share)
    most = [(frames, found) for frames, found in sorted(at.items()) if 2 * len(found) > len(curves)]
    return [(frames, float(np.mean(found))) for frames, found in most]
