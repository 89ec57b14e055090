"""Outcomes of runs as matrices, and success in a scene as a grid of stacks and conditions."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.report.runs import SPEEDS, Condition, Run, in_order
from flowrep.report.statistics import Array, Bootstrap, Estimate, rates

BASELINES = ("never_turn", "random", "planner")

Metric = Callable[[NDArray[Any]], Array]


def success(outcomes: NDArray[Any]) -> Array:
    """Returns 1 for each success, else 0."""
    return (outcomes == "success").astype(float)


def out_of_bounds_of_both(outcomes: NDArray[Any]) -> Array:
    """Returns 1 out of bounds, 0 for a collision, else nan: the paper's Table III."""
    return np.where(
        outcomes == "out_of_bounds", 1.0, np.where(outcomes == "collision", 0.0, np.nan)
    )


@dataclass(frozen=True)
class OutcomeMatrix:
    """The outcomes of the runs of one stack in one scene and condition.

    Args:
        seeds: the runs' seeds, in the order of rows.
        episodes: the episodes' seeds, in the order of columns.
        outcomes: `[R, E]`, the metric of each episode, nan where it was not driven.
    """

    seeds: tuple[int, ...]
    episodes: Array
    outcomes: Array

    @property
    def counts(self) -> str:
        """The numbers of seeds and episodes, as text: `3 × 192`."""
        of_each = (~np.isnan(self.outcomes)).sum(axis=1)
        low, high = of_each.min(), of_each.max()
        return f"{len(self.seeds)} × {low}" + (f"–{high}" if high > low else "")

    def on(self, episodes: Array) -> Array:
        """Returns the outcomes in these episodes, which it must have."""
        return self.outcomes[:, np.searchsorted(self.episodes, episodes)]

    @property
    def shared(self) -> Array:
        """The episodes that every run drove."""
        return self.episodes[~np.isnan(self.outcomes).any(axis=0)]


def outcomes_of(
    runs: Iterable[Run], condition: Condition, metric: Metric = success
) -> OutcomeMatrix | None:
    """Returns the outcomes of runs of one stack and scene; None if the condition has none.

    An episode has one column, whichever runs drove it.
    """
    found = []
    for run in sorted(runs, key=lambda run: run.seed):
        driven = run.under(condition)
        if len(driven["outcome"]):
            found.append((run.seed, driven["episode_seed"], metric(driven["outcome"])))
    if not found:
        return None
    episodes = np.unique(np.concatenate([seeds for _, seeds, _ in found]))
    outcomes = np.full((len(found), len(episodes)), np.nan)
    for row, (_, seeds, values) in enumerate(found):
        outcomes[row, np.searchsorted(episodes, seeds)] = values
    return OutcomeMatrix(tuple(seed for seed, _, _ in found), episodes, outcomes)


def side_by_side(first: OutcomeMatrix, second: OutcomeMatrix) -> tuple[Array, Array]:
    """Returns the outcomes of two matrices in the episodes that every run of both drove."""
    shared = np.intersect1d(first.shared, second.shared)
    return first.on(shared), second.on(shared)


def change(before: OutcomeMatrix | None, after: OutcomeMatrix | None) -> Array | None:
    """Returns `[R, E]`, the change for each run and episode of both; None if they share none.

    A run that drove no episode under both conditions is no part of it.
    """
    if before is None or after is None:
        return None
    seeds = [seed for seed in before.seeds if seed in after.seeds]
    episodes = np.intersect1d(before.episodes, after.episodes)
    if not seeds or not len(episodes):
        return None
    ours, theirs = (m.on(episodes)[[m.seeds.index(s) for s in seeds]] for m in (before, after))
    changes = theirs - ours
    driven = ~np.isnan(changes).all(axis=1)
    return changes[driven] if driven.any() else None


def baseline_share(runs: Sequence[Run], condition: Condition) -> float | None:
    """Returns the success rate of a baseline, the condition's policy; None if it did not drive.

    Its drive of an episode doesn't depend on the agent beside it, so each episode counts once.
    """
    driven = outcomes_of(runs, condition)
    return None if driven is None else float(np.nanmax(driven.outcomes, axis=0).mean())


class Score(NamedTuple):
    """An estimate of success, each seed's success, and the numbers of seeds and episodes."""

    estimate: Estimate
    of_seeds: tuple[float, ...]
    counts: str


@dataclass(frozen=True)
class Grid:
    """Success in one scene: a score for each series and condition, None where it is missing.

    Args:
        scene: the scene's name.
        series: the compared stacks, or stacks of groups, in the figure's order.
        conditions: groups of bars, or points of a line.
        matrices: the outcomes behind the scores.
        scores: by series and condition.
        baselines: success by the baseline's name and condition.
    """

    scene: str
    series: tuple[str, ...]
    conditions: tuple[Condition, ...]
    matrices: Mapping[tuple[str, Condition], OutcomeMatrix | None]
    scores: Mapping[tuple[str, Condition], Score | None]
    baselines: Mapping[tuple[str, Condition], float] = field(default_factory=dict)


def grid_of(
    scene: str,
    runs: Mapping[str, Sequence[Run]],
    conditions: Sequence[Condition],
    bootstrap: Bootstrap,
    baselines: Sequence[str] = BASELINES,
) -> Grid:
    """Returns the success of several series of runs in a scene.

    Args:
        scene: the scene's name; runs of other scenes are left out.
        runs: the runs of each series, possibly none.
        conditions: the conditions in which they are compared.
        bootstrap: computes the intervals.
        baselines: names of baselines; none where the runs' configs differ, since a baseline's
            drives may differ too.
    """
    here = {name: [run for run in members if run.scene == scene] for name, members in runs.items()}
    found = {(name, c): outcomes_of(here[name], c) for name, c in product(runs, conditions)}
    scores = {place: score_of(matrix, bootstrap) for place, matrix in found.items()}
    everybody = [run for members in here.values() for run in members]
    shares = {
        (name, c): baseline_share(everybody, c._replace(policy=name))
        for name, c in product(baselines, conditions)
    }
    driven = {place: share for place, share in shares.items() if share is not None}
    return Grid(scene, tuple(runs), tuple(conditions), found, scores, driven)


def score_of(matrix: OutcomeMatrix | None, bootstrap: Bootstrap) -> Score | None:
    """Returns the success of a matrix's runs."""
    if matrix is None:
        return None
    of_seeds = tuple(rates(matrix.outcomes).tolist())
    return Score(bootstrap.success([matrix.outcomes]), of_seeds, matrix.counts)


def by_stack(runs: Sequence[Run], stacks: Sequence[str]) -> dict[str, list[Run]]:
    """Returns the runs of each of these stacks."""
    return {stack: [run for run in runs if run.stack == stack] for stack in stacks}


def speeds_tested(runs: Sequence[Run], policy: str, fps: float) -> list[str]:
    """Returns the speed modes in which runs were evaluated."""
    return in_order(
        [c.speed for run in runs for c in run.conditions if c[::2] == (policy, fps)], SPEEDS
    )


def rates_tested(runs: Sequence[Run], policy: str, speed: str) -> list[float]:
    """Returns the frame rates at which runs were evaluated, the lowest first."""
    return sorted({c.fps for run in runs for c in run.conditions if c[:2] == (policy, speed)})


class Curve(NamedTuple):
    """One run's (frames, share of success) in evaluations and in training episodes."""

    evaluated: list[tuple[int, float]]
    training: list[tuple[int, float]]


def curve_of(run: Run) -> Curve:
    """Returns greedy evaluations at the run's own speed and frame rate, and training episodes.

    At the frames of the final evaluation, that one alone counts: its episodes are others.
    """
    e = run.episodes
    own = (e["scene"] == run.scene) & (e["speed"] == run.speed) & (e["fps"] == run.fps)
    own &= e["policy"] == "greedy"
    evaluated: dict[int, float] = {}
    for kind in ("training", "final"):
        chosen = own & (e["evaluation"] == kind)
        frames, outcomes = e["frames"][chosen], success(e["outcome"][chosen])
        at = np.unique(frames).tolist()
        evaluated |= {f: float(outcomes[frames == f].mean()) for f in at}
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
