"""Outcomes of the runs of one stack in one scene under one condition, as arrays."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flowrep.report.runs import Condition, Run
from flowrep.report.statistics import Array

BASELINES = ("never_turn", "random", "planner")

Judge = Callable[[Mapping[str, str]], float]


@dataclass(frozen=True)
class Cell:
    """The outcomes of the runs of one stack in one scene and condition.

    Args:
        seeds: the runs' seeds, in the order of rows.
        episodes: the episodes' seeds, in the order of columns.
        outcomes: `[R, E]`, the judge's value of each episode, nan where it was not driven.
    """

    seeds: tuple[int, ...]
    episodes: tuple[int, ...]
    outcomes: Array

    @property
    def counts(self) -> str:
        """The numbers of seeds and episodes, as text: `3 × 192`."""
        of_each = (~np.isnan(self.outcomes)).sum(axis=1)
        low, high = of_each.min(), of_each.max()
        return f"{len(self.seeds)} × {low}" + (f"–{high}" if high > low else "")

    @property
    def shared(self) -> set[int]:
        """The episodes that every run drove."""
        by_episode = zip(self.episodes, self.outcomes.T)
        return {episode for episode, of_runs in by_episode if not np.isnan(of_runs).any()}


def success(row: Mapping[str, str]) -> float:
    """Judges an episode: 1 for a success, else 0."""
    return float(row["outcome"] == "success")


def out_of_bounds_of_both(row: Mapping[str, str]) -> float:
    """Judges a failure as in the paper's Table III: 1 out of bounds, 0 collision, else nan."""
    return {"out_of_bounds": 1.0, "collision": 0.0}.get(row["outcome"], np.nan)


def cell_of(runs: Iterable[Run], condition: Condition, judge: Judge = success) -> Cell | None:
    """Returns the outcomes of runs of one stack and scene; None if the condition has none.

    An episode has one column, whichever runs drove it.
    """
    found: list[tuple[int, dict[int, float]]] = []
    for run in sorted(runs, key=lambda run: run.seed):
        driven = {
            int(row["episode_seed"]): judge(row) for row in run.by_condition.get(condition, ())
        }
        if driven:
            found.append((run.seed, driven))
    if not found:
        return None
    episodes = sorted({seed for _, driven in found for seed in driven})
    outcomes = np.array([[driven.get(e, np.nan) for e in episodes] for _, driven in found])
    return Cell(tuple(seed for seed, _ in found), tuple(episodes), outcomes)


def side_by_side(first: Cell, second: Cell) -> tuple[Array, Array]:
    """Returns the outcomes of two cells in the episodes that every run of both drove."""
    shared = first.shared & second.shared
    ours, theirs = (
        cell.outcomes[:, [episode in shared for episode in cell.episodes]]
        for cell in (first, second)
    )
    return ours, theirs


def baseline_share(runs: Sequence[Run], condition: Condition) -> float | None:
    """Returns the success rate of a baseline, the condition's policy; None if it did not drive.

    Its drive of an episode doesn't depend on the agent beside it, so each episode counts once.
    """
    driven = {
        int(row["episode_seed"]): success(row)
        for run in runs
        for row in run.by_condition.get(condition, ())
    }
    return float(np.mean(list(driven.values()))) if driven else None
