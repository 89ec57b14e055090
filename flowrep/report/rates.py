"""Success over frame rates: agents trained at one rate, evaluated at others."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from flowrep.report.cells import Cell
from flowrep.report.comparing import INTERVALS, Settings, scenes_of
from flowrep.report.experiments import COMPLEMENTARY, STACKS
from flowrep.report.figures import draw_rates
from flowrep.report.results import Grid, by_stack, grid_of, in_order, rates_tested
from flowrep.report.runs import Condition, Run
from flowrep.report.sections import MISSING, Drawing, Section, percent, points, what_is_missing
from flowrep.report.statistics import Array
from flowrep.report.style import words
from flowrep.report.tables import Table

_MOST_LINES = 6  # in one panel


def has_rates(runs: Sequence[Run], ask: Settings) -> bool:
    """Returns whether runs were evaluated at more than one frame rate."""
    return bool(runs) and len(rates_tested(runs, ask.policy, runs[0].speed)) > 1


def rate_section(runs: Sequence[Run], ask: Settings) -> Section:
    """Returns success at the training speed over all frame rates that were evaluated."""
    speed, trained = runs[0].speed, runs[0].fps
    ours = [run for run in runs if len(rates_tested([run], ask.policy, speed)) > 1]
    conditions = [Condition(ask.policy, speed, r) for r in rates_tested(ours, ask.policy, speed)]
    series = by_stack(ours, in_order([run.stack for run in ours], STACKS))
    grids = [grid_of(scene, series, conditions, ask.bootstrap) for scene in scenes_of(ours)]
    caption = (
        f"Success over the frame rate of the evaluation, trained at {trained:g} frames a second, "
        f"{speed} speed, {ask.policy} actions: {INTERVALS}. Points of one rate stand side by side."
    )
    return Section(
        "frame_rate",
        "Sensitivity to the frame rate",
        what_is_missing(grids),
        tuple(_drawings(grids, caption)),
        (rate_table(grids, caption, ask),),
    )


def _drawings(grids: Sequence[Grid], caption: str) -> Iterator[Drawing]:
    """Yields the paper's figure, and another if there are more stacks than it can show."""
    series = grids[0].series
    papers = [name for name in series if name in COMPLEMENTARY.stacks]
    others = [name for name in series if name not in papers]
    if len(series) <= _MOST_LINES or not papers:
        papers, others = list(series), []
    for name, shown in (("frame_rate", papers), ("frame_rate_others", others)):
        if shown:
            panels = tuple(replace(grid, series=tuple(shown)) for grid in grids)
            yield Drawing(name, caption, panels, draw_rates)


def rate_table(grids: Sequence[Grid], caption: str, ask: Settings) -> Table:
    """Returns success in % by frame rate, and the change from the highest to the lowest."""
    conditions = grids[0].conditions
    low, high = conditions[0], conditions[-1]
    blocks = []
    for grid in grids:
        rows = []
        for series in grid.series:
            scores = [grid.scores[series, c] for c in conditions]
            cells = [percent(score.estimate) if score else MISSING for score in scores]
            changes = change(grid.cells[series, high], grid.cells[series, low])
            told = MISSING if changes is None else points(ask.bootstrap.mean([changes]))
            rows.append((series, *cells, told))
        blocks.append((words(grid.scene), tuple(rows)))
    header = (
        "representations",
        *(f"{c.fps:g} Hz (%)" for c in conditions),
        f"{high.fps:g} → {low.fps:g} Hz (points)",
    )
    extra = "The last column is the change of the same agents on the same episodes."
    return Table("frame_rate_success", f"In %. {caption} {extra}", header, tuple(blocks))


def change(before: Cell | None, after: Cell | None) -> Array | None:
    """Returns `[R, E]`, the change for each run and episode of both; None if they share none.

    A run that drove no episode under both conditions is no part of it.
    """
    if before is None or after is None:
        return None
    seeds = [seed for seed in before.seeds if seed in after.seeds]
    episodes = sorted({*before.episodes} & {*after.episodes})
    if not seeds or not episodes:
        return None

    def both(cell: Cell) -> Array:
        rows = [cell.seeds.index(seed) for seed in seeds]
        columns = np.searchsorted(cell.episodes, episodes)
        return cell.outcomes[rows][:, columns]

    changes = both(after) - both(before)
    told = ~np.isnan(changes).all(axis=1)
    return changes[told] if told.any() else None
