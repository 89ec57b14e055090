"""Runs for a report, read from folders: which may be compared, and the success of episodes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from flowrep.config.options import BaselineName, SpeedMode
from flowrep.experiment.outcomes import columns_for
from flowrep.experiment.provenance import flattened, origin_of
from flowrep.experiment.run import RunFolder, RunFolderError
from flowrep.files import TableError
from flowrep.report.statistics import Array, Estimate, mean_share

Cells = Mapping[str, Sequence[str]]
"""A table's text by column."""
Columns = dict[str, NDArray[Any]]
"""A table by column."""
Score = Callable[[Sequence[NDArray[Any]]], float]
"""Returns a run's score from the outcomes of its episodes under each condition."""

SPEEDS: tuple[str, ...] = get_args(SpeedMode)
# The paper's scenes and stacks, in the order of its figures.
SCENES = ("straight_road", "s_turn", "h_shaped_pathways", "three_way_junction")
FLOW_STACKS = ("ego", "raw", "obj", "ego+obj")
COMPLEMENTARY_STACKS = (
    "seg2", "depth2", "ego+obj", "ego+obj+seg2", "ego+obj+depth2", "ego+obj+seg2+depth2",
)  # fmt: skip
STACKS = tuple(dict.fromkeys(FLOW_STACKS + COMPLEMENTARY_STACKS))
_REPRESENTATIONS = ("raw", "ego", "obj", "seg", "seg2", "depth", "depth2", "rgb")
_SHARED_SCENE_KEYS = ("camera", "frame_rate_hz")  # keys whose values are the same in all scenes
EPISODE_COLUMNS = columns_for("key", "result")


class Condition(NamedTuple):
    """How agents were evaluated: policy, pedestrians' speed mode, frames per second."""

    policy: str
    speed: str
    fps: float


@dataclass(eq=False)
class Run:
    """A run's config and tables."""

    name: str  # its folder
    config: Mapping[str, Any]
    episodes: Columns  # of evaluation.csv
    metrics: Columns  # of metrics.csv, nan where a cell is empty
    folder: Path | None = None  # None of a packed run
    machine: Mapping[str, str] = field(default_factory=dict)  # that trained it, of a packed run

    def __post_init__(self) -> None:
        config, scene = self.config, self.config["scene"]
        self.scene = str(scene["name"])
        self.stack = stack_of(config["representations"])
        self.seed = int(config["seed"])
        self.speed = str(config["speed"])  # of the pedestrians in training
        self.fps = float(scene["frame_rate_hz"])
        self.total_frames = int(config["total_frames"])
        # Rows of metrics come at intervals, so the last frames may have left episodes alone.
        columns = (self.metrics.get("frames", np.zeros(0)), self.episodes["frames"])
        self.frames = max((int(c.max()) for c in columns if len(c)), default=0)
        self.is_trained = self.frames >= self.total_frames  # to the end; perhaps not evaluated yet
        self.settings = _settings(config)

    @cached_property
    def tested(self) -> NDArray[np.bool_]:
        """Which episodes the finished agent drove in the scene of its training, each one once."""
        e = self.episodes
        here = e["scene"] == self.scene
        while_training = e["scene_id"][here & (e["evaluation"] != "evaluate")]
        if len(while_training):  # the scene may have changed since, under the same name
            here &= e["scene_id"] == while_training[0]
        here &= (e["evaluation"] != "training") & (e["frames"] >= self.total_frames)
        rows = np.flatnonzero(here)
        rows = rows[np.argsort(e["frames"][rows], kind="stable")]
        cells = (e[name][rows].tolist() for name in (*Condition._fields, "episode_seed"))
        once = dict(zip(zip(*cells), rows.tolist()))  # the row of the most frames is the last
        here[:] = False
        here[[*once.values()]] = True
        return here

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


def read_runs(folders: Iterable[Path]) -> tuple[list[Run], list[str]]:
    """Returns the runs in folders at any depth, and a warning for each that was left out."""
    runs: list[Run] = []
    warnings: list[str] = []
    for folder in RunFolder.all_in(folders):
        try:
            runs.append(read_run(folder.path))
        except (RunFolderError, TableError, OSError, UnicodeDecodeError) as error:
            warnings.append(" ".join(str(error).split()))
    return runs, warnings


def read_run(path: Path) -> Run:
    """Returns the run in a folder; raises RunFolderError or TableError for a damaged one."""
    folder = RunFolder.existing(path)
    try:
        config = folder.read_config()
        tables = folder.read_episodes(), folder.read_metrics()
        episodes, metrics = (
            {k: [row[k] for row in t] for k in (t[0] if t else ())} for t in tables
        )
        columns = episode_columns(episodes), metric_columns(metrics)
        return Run(str(path), config, *columns, path)
    except (RunFolderError, TableError):
        raise
    # Overflow: a seed of .inf, or of more digits than an integer of numpy holds.
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as e:
        what = f"config.yaml or a table is not what a run leaves ({e!r})"
        raise RunFolderError(f"{path}: {what}; restore the file that the run wrote") from None


def episode_columns(cells: Cells) -> Columns:
    """Returns the columns of evaluation.csv that a report reads, "" for missing ones."""
    empty = [""] * len(cells.get("frames", ()))
    kinds = EPISODE_COLUMNS.items()
    return {name: np.array(cells.get(name, empty), kind) for name, kind in kinds}


def metric_columns(cells: Cells) -> Columns:
    """Returns the columns of metrics.csv, nan for empty cells."""
    return {name: np.array([float(x or "nan") for x in column]) for name, column in cells.items()}


def without_repeats(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Returns one run per config and seed, the one with the most tested episodes.

    The second value has a warning for each run that is left out.
    """
    kept: dict[Any, Run] = {}
    warnings = []
    # The most complete run comes first, and `setdefault` keeps it.
    for run in sorted(runs, key=lambda run: (-int(run.tested.sum()), -run.frames)):
        best = kept.setdefault((run.stack, run.seed, *sorted(run.settings.items())), run)
        if run is not best:
            same = f"{run.name} is the same run as {best.name}, config and seed"
            warnings.append(f"{same}: left out, as it would count as another seed")
    return [run for run in runs if run in kept.values()], warnings


def _settings(config: Mapping[str, Any]) -> dict[str, str]:
    """Returns everything but the seed on which the weights depend, by dotted key.

    Keys of a single scene are under the scene's name, and options of a representation under its
    name, so that only runs that have them can differ in them.
    """
    parts = origin_of(config) | {"total_frames": config["total_frames"]}
    del parts["flowrep"], parts["seed"]
    scene = parts.pop("scene")
    # Two scenes always differ in their layout, which must not keep their runs from one report.
    shared = {key: scene.pop(key) for key in _SHARED_SCENE_KEYS if key in scene}
    parts["scene"] = shared | {scene["name"]: scene}
    return {
        key: str(_without_fractions(value))
        for key, value in flattened(parts).items()
        if value is not None and value != {}  # options that are off may be younger than a run
    }


def _without_fractions(value: Any) -> Any:
    # 4.0 in a file is 4 on a command line
    if isinstance(value, list):
        return [_without_fractions(part) for part in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def in_order(names: Iterable[str], known: Sequence[str]) -> list[str]:
    """Returns names without repeats: known ones first, in their order, then the others sorted."""
    unique = set(names)
    return [name for name in known if name in unique] + sorted(unique - set(known))


def stack_of(representations: Iterable[str]) -> str:
    """Returns the name of a stack, a set of representations, whatever their order."""
    return "+".join(in_order(representations, _REPRESENTATIONS))


def scenes_of(runs: Sequence[Run]) -> list[str]:
    """Returns the scenes that runs were trained in, the paper's first."""
    return in_order([run.scene for run in runs], SCENES)


def in_stacks(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Returns the runs by stack, the paper's stacks first."""
    stacks = in_order([run.stack for run in runs], STACKS)
    return {stack: [run for run in runs if run.stack == stack] for stack in stacks}


class Group(NamedTuple):
    """Runs that may be compared, and their values of the keys in which groups differ."""

    runs: tuple[Run, ...]
    differences: dict[str, str]

    @property
    def label(self) -> str:
        """What distinguishes it from the other groups; empty if there are none."""
        shown = [f"{key}={value}"[:60] for key, value in self.differences.items()]
        return ", ".join(shown if len(shown) < 5 else [*shown[:3], f"{len(shown) - 3} more keys"])


def groups_of(runs: Sequence[Run]) -> list[Group]:
    """Returns groups of runs that differ only in scene, representations and seed, largest first."""
    keys = dict.fromkeys(key for run in runs for key in run.settings)
    # "absent" is a value, too: a later version may have added the key
    values = [{k: run.settings.get(k, "absent") for k in keys if _has_key(run, k)} for run in runs]
    differing = [key for key in keys if len({of[key] for of in values if key in of}) > 1]
    groups: dict[tuple[tuple[str, str], ...], list[Run]] = {}
    for run, of in zip(runs, values):
        groups.setdefault(tuple((k, of[k]) for k in differing if k in of), []).append(run)
    every = [Group(tuple(members), dict(identity)) for identity, members in groups.items()]
    return sorted(every, key=lambda group: -len(group.runs))


def _has_key(run: Run, key: str) -> bool:
    section, _, rest = key.partition(".")
    name = rest.split(".")[0]
    # A run without a map can't differ in its options, nor one scene in the layout of another.
    if section == "representations":
        return name in run.config[section]
    return section != "scene" or name in (*_SHARED_SCENE_KEYS, run.scene)


def success_rate(outcomes: Sequence[NDArray[Any]]) -> float:
    """Returns the share of episodes that succeed."""
    return float((np.concatenate(outcomes) == "success").mean())


def departures(outcomes: Sequence[NDArray[Any]]) -> float:
    """Returns departures from the road as a share of departures and collisions, nan without both.

    This is the paper's Table III.
    """
    ends = np.concatenate(outcomes)
    out, hit = (ends == "out_of_bounds").sum(), (ends == "collision").sum()
    return float(out / (out + hit)) if out + hit else float("nan")


def scores_of(
    runs: Iterable[Run], conditions: Sequence[Condition], score: Score = success_rate
) -> Array:
    """Returns the score of each run `[R]` over all of its episodes, sorted by seed.

    Runs that lack a condition are left out, as are runs whose score is nan.
    """
    # A mean over fewer conditions would set easy ones against hard ones.
    ours = [r for r in sorted(runs, key=lambda r: r.seed) if r.conditions.issuperset(conditions)]
    scores = np.array([score([run.under(c)["outcome"] for c in conditions]) for run in ours])
    return scores[~np.isnan(scores)]


def paired_scores(
    sides: Sequence[Sequence[Run]], conditions: Sequence[Condition], score: Score = success_rate
) -> tuple[list[Array], int] | None:
    """Returns the score of each run of each side, over the episodes that all of them drove.

    Differences then don't depend on the difficulty of episodes. The second value is the number of
    these episodes; without any, the result is None. Runs that lack a condition are left out.
    """
    # One run without a condition would leave no shared episode, and so no comparison at all.
    ours = [[run for run in side if run.conditions.issuperset(conditions)] for side in sides]
    if not all(ours):
        return None
    driven = [[[run.under(c) for c in conditions] for run in side] for side in ours]
    seeds = (columns["episode_seed"] for side in driven for tables in side for columns in tables)
    shared = reduce(np.intersect1d, seeds)
    if not len(shared):
        return None

    def scored(tables: Sequence[Columns]) -> float:
        return score([c["outcome"][np.isin(c["episode_seed"], shared)] for c in tables])

    return [np.array([scored(tables) for tables in side]) for side in driven], len(shared)


def changes(runs: Iterable[Run], before: Condition, after: Condition) -> Array:
    """Returns each run's change of success `[R]`, in the episodes that it drove under both."""

    def change(outcomes: Sequence[NDArray[Any]]) -> float:
        return success_rate(outcomes[1:]) - success_rate(outcomes[:1])

    pairs = [paired_scores([[run]], (before, after), change) for run in runs]
    return np.array([scores[0] for (scores,), _ in filter(None, pairs)])


def baseline_share(runs: Iterable[Run], condition: Condition) -> float | None:
    """Returns the success rate of a baseline (the condition's policy), None if it did not drive."""
    driven = [run.under(condition) for run in runs]
    seeds, outcomes = (
        np.concatenate([c[name] for c in driven]) for name in ("episode_seed", "outcome")
    )
    # A baseline drives an episode in the same way in every run, so each episode counts once.
    _, first = np.unique(seeds, return_index=True)
    return success_rate([outcomes[first]]) if len(first) else None


class Cell(NamedTuple):
    """The success of one series in one scene and condition."""

    rates: Array  # of its runs [R]
    counts: str  # seeds × episodes, as text: `3 × 192`
    score: Estimate


class SuccessGrid(NamedTuple):
    """Success in one scene, by series and condition; a series is a stack, or a stack's config.

    Series without runs under a condition have no cell.
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
    # Wilson's interval is for the run with the fewest episodes: rather too wide than too narrow.
    rates, fewest, most = scores_of(runs, [condition]), min(driven), max(driven)
    counts = f"{len(rates)} × {fewest}" + (f"–{most}" if most > fewest else "")
    return Cell(rates, counts, mean_share([rates], fewest))


def grid_of(
    scene: str,
    series: Mapping[str, Sequence[Run]],
    conditions: Sequence[Condition],
    baselines: Sequence[str] = get_args(BaselineName),
) -> SuccessGrid:
    """Returns the success of several series of runs in a scene, without runs of other scenes."""
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
    return SuccessGrid(scene, tuple(series), tuple(conditions), cells, shares)


class Curve(NamedTuple):
    """One run's (frames, share of success) in evaluations and in training episodes."""

    evaluated: list[tuple[int, float]]
    training: list[tuple[int, float]]


def curve_of(run: Run) -> Curve:
    """Returns greedy evaluations at the run's speed and frame rate, and its training episodes."""
    e = run.episodes
    here = (e["scene"] == run.scene) & (e["speed"] == run.speed) & (e["fps"] == run.fps)
    here &= e["policy"] == "greedy"
    evaluated: dict[int, float] = {}
    # At the last frame count, the final evaluation replaces that of training: other episodes.
    for kind in ("training", "final"):
        chosen = here & (e["evaluation"] == kind)
        frames, outcomes = e["frames"][chosen], e["outcome"][chosen]
        at = np.unique(frames).tolist()
        evaluated |= {f: success_rate([outcomes[frames == f]]) for f in at}
    logged = zip(run.metrics.get("frames", ()), run.metrics.get("success", ()))
    training = [(int(frames), float(share)) for frames, share in logged if not np.isnan(share)]
    return Curve(sorted(evaluated.items()), training)
