"""Results of a family's runs by scene: estimates for each stack and condition."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple

from flowrep.report.cells import BASELINES, Cell, baseline_share, cell_of
from flowrep.report.runs import SPEEDS, Condition, Run
from flowrep.report.statistics import Bootstrap, Estimate, rates


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
        series: the compared stacks, or stacks of families, in the figure's order.
        conditions: groups of bars, or points of a line.
        cells: the outcomes behind the scores.
        scores: by series and condition.
        baselines: success by the baseline's name and condition.
    """

    scene: str
    series: tuple[str, ...]
    conditions: tuple[Condition, ...]
    cells: Mapping[tuple[str, Condition], Cell | None]
    scores: Mapping[tuple[str, Condition], Score | None]
    baselines: Mapping[tuple[str, Condition], float] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Returns whether it has no score at all."""
        return all(score is None for score in self.scores.values())


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
    cells = {(name, c): cell_of(here[name], c) for name, c in product(runs, conditions)}
    scores = {place: score_of(cell, bootstrap) for place, cell in cells.items()}
    everybody = [run for members in here.values() for run in members]
    shares = {
        (name, c): baseline_share(everybody, c._replace(policy=name))
        for name, c in product(baselines, conditions)
    }
    found = {place: share for place, share in shares.items() if share is not None}
    return Grid(scene, tuple(runs), tuple(conditions), cells, scores, found)


def score_of(cell: Cell | None, bootstrap: Bootstrap) -> Score | None:
    """Returns the success of a cell's runs."""
    if cell is None:
        return None
    of_seeds = tuple(float(rate) for rate in rates(cell.outcomes))
    return Score(bootstrap.success([cell.outcomes]), of_seeds, cell.counts)


def by_stack(runs: Sequence[Run], stacks: Sequence[str]) -> dict[str, list[Run]]:
    """Returns the runs of each of these stacks."""
    return {stack: [run for run in runs if run.stack == stack] for stack in stacks}


def in_order(found: Sequence[str], known: Sequence[str]) -> list[str]:
    """Returns the found names without repeats, the known ones first and in their order."""
    first = [name for name in known if name in found]
    return first + sorted(set(found) - set(first))


def speeds_tested(runs: Sequence[Run], policy: str, fps: float) -> list[str]:
    """Returns the speed modes in which runs were evaluated."""
    found = [c.speed for run in runs for c in run.by_condition if c[::2] == (policy, fps)]
    return in_order(found, SPEEDS)


def rates_tested(runs: Sequence[Run], policy: str, speed: str) -> list[float]:
    """Returns the frame rates at which runs were evaluated, the lowest first."""
    return sorted({c.fps for run in runs for c in run.by_condition if c[:2] == (policy, speed)})
