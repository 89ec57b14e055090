"""Sections that compare stacks by success: the paper's bar charts, and those of any runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from flowrep.report.cells import BASELINES, side_by_side
from flowrep.report.experiments import SCENES, Experiment
from flowrep.report.figures import draw_bars
from flowrep.report.results import Grid, by_stack, grid_of, in_order, speeds_tested
from flowrep.report.runs import SPEEDS, Condition, Run
from flowrep.report.sections import (
    MISSING,
    Drawing,
    Section,
    listed,
    percent,
    points,
    what_is_missing,
)
from flowrep.report.statistics import FEWEST_SEEDS, Bootstrap
from flowrep.report.style import words
from flowrep.report.tables import Table

INTERVALS = (
    "the interquartile mean over seeds (of up to three, their mean) with 95 % intervals: by a "
    "bootstrap over seeds and episodes, of a single seed Wilson's over its episodes"
)
_MOST_PAIRS = 15


@dataclass(frozen=True)
class Settings:
    """A report's choice of evaluations and intervals.

    Args:
        policy: "greedy" or "sampled".
        bootstrap: computes the intervals.
    """

    policy: str
    bootstrap: Bootstrap


def scenes_of(runs: Sequence[Run]) -> list[str]:
    """Returns the scenes that runs were trained in, the paper's first."""
    return in_order([run.scene for run in runs], SCENES)


def experiment_section(experiment: Experiment, runs: Sequence[Run], ask: Settings) -> Section:
    """Returns the section of one of the paper's comparisons of stacks."""
    ours = [run for run in runs if run.stack in experiment.stacks]
    series = by_stack(ours, experiment.stacks)
    section = success_section(
        experiment.name, experiment.title, series, experiment.pairs, ask, experiment.speeds
    )
    absent = [words(scene) for scene in SCENES if scene not in scenes_of(ours)]
    note = (f"No runs in {listed(absent)}.",) if absent else ()
    return replace(section, notes=(*section.notes, *note))


def success_section(
    name: str,
    title: str,
    series: Mapping[str, Sequence[Run]],
    pairs: Sequence[tuple[str, str]] | None,
    ask: Settings,
    shown: Sequence[str] | None = None,
    baselines: Sequence[str] = BASELINES,
) -> Section:
    """Returns bars, a table of success and one of differences for series of runs.

    Args:
        name: the section's name.
        title: the section's heading.
        series: the runs of each series.
        pairs: series whose differences are listed; None for all, up to 15.
        ask: policy and intervals.
        shown: speed modes in the figure, None for all evaluated ones; the tables have all.
        baselines: see `grid_of`.
    """
    runs = [run for members in series.values() for run in members]
    fps = runs[0].fps
    tested = speeds_tested(runs, ask.policy, fps)
    speeds = in_order([*tested, *(shown or ())], SPEEDS)
    conditions = [Condition(ask.policy, speed, fps) for speed in speeds]
    grids = [
        grid_of(scene, series, conditions, ask.bootstrap, baselines) for scene in scenes_of(runs)
    ]
    drawn = [_only(grid, shown) for grid in grids] if shown else grids
    trained = listed(sorted({run.speed for run in runs}))
    caption = (
        f"Success of agents trained at {trained} speed, {ask.policy} actions, {fps:g} frames a "
        f"second: {INTERVALS}; dots are the seeds."
    )
    tables = [success_table(name, grids, caption, ask.bootstrap)]
    differences = difference_table(name, grids, pairs, ask.bootstrap)
    if differences is not None:
        tables.append(differences)
    return Section(
        name,
        title,
        what_is_missing(grids),
        (Drawing(name, caption, tuple(drawn), draw_bars),),
        tuple(tables),
    )


def _only(grid: Grid, speeds: Sequence[str]) -> Grid:
    kept = tuple(c for c in grid.conditions if c.speed in speeds)
    return replace(grid, conditions=kept)


def success_table(name: str, grids: Sequence[Grid], caption: str, bootstrap: Bootstrap) -> Table:
    """Returns success in % by scene and series, and over all scenes where there are several."""
    conditions = grids[0].conditions
    blocks = []
    for grid in grids:
        rows = []
        for series in grid.series:
            scores = [grid.scores[series, c] for c in conditions]
            cells = [percent(score.estimate) if score else MISSING for score in scores]
            counts = dict.fromkeys(score.counts for score in scores if score)
            rows.append((series, *cells, ", ".join(counts) or "0"))
        for baseline in dict.fromkeys(baseline for baseline, _ in grid.baselines):
            shares = [grid.baselines.get((baseline, c)) for c in conditions]
            cells = [MISSING if share is None else f"{100 * share:.0f}" for share in shares]
            rows.append((baseline.replace("_", " "), *cells, ""))
        blocks.append((words(grid.scene), tuple(rows)))
    if len(grids) > 1:
        blocks.append((f"All {len(grids)} scenes", _over_scenes(grids, bootstrap)))
    header = ("representations", *(f"{c.speed} (%)" for c in conditions), "seeds × episodes")
    return Table(f"{name}_success", f"In %. {caption}", header, tuple(blocks))


def _over_scenes(grids: Sequence[Grid], bootstrap: Bootstrap) -> tuple[tuple[str, ...], ...]:
    rows = []
    for series in grids[0].series:
        cells = []
        for condition in grids[0].conditions:
            found = [grid.cells[series, condition] for grid in grids]
            here = [cell.outcomes for cell in found if cell is not None]
            whole = len(here) == len(found)
            cells.append(percent(bootstrap.success(here)) if whole else MISSING)
        rows.append((series, *cells, ""))
    return tuple(rows)


def difference_table(
    name: str,
    grids: Sequence[Grid],
    pairs: Sequence[tuple[str, str]] | None,
    bootstrap: Bootstrap,
) -> Table | None:
    """Returns the difference of each pair with its verdict; None if there is no pair to compare."""
    every = list(combinations(reversed(grids[0].series), 2)) if pairs is None else pairs
    pairs = every[:_MOST_PAIRS] if pairs is None else pairs
    places = [(words(grid.scene), [grid]) for grid in grids]
    if len(grids) > 1:
        places.append((f"All {len(grids)} scenes", list(grids)))
    blocks, told = [], 0
    for heading, members in places:
        rows = []
        for first, second in pairs:
            for condition in grids[0].conditions:
                row = _difference_row(members, first, second, condition, bootstrap)
                if row is not None:
                    rows.append(row)
        told += sum(row[-1] != "0" for row in rows)
        if rows:
            blocks.append((heading, tuple(rows)))
    if not blocks:
        return None
    caption = (
        "First minus second in percentage points, on the episodes that all runs of both drove, "
        "with 95 % bootstrap intervals over seeds and episodes; the probability that a run of the "
        "first beats one of the second (a tie counts half); p of Welch's t-test over seeds. A "
        "difference is told from noise where its interval leaves out 0 and p < 0.05; of fewer than "
        f"{FEWEST_SEEDS} seeds a side it is one of these agents."
    )
    caption = " ".join(filter(None, (caption, _by_chance(told), _left_out(pairs, every))))
    header = ("first − second", "speed", "points", "verdict", "P(first better) (%)", "p", "shared")
    return Table(f"{name}_differences", caption, header, tuple(blocks), words=(1, 3))


def _by_chance(comparisons: int) -> str:
    if comparisons < 2:
        return ""
    about = f"{comparisons / 20:.1f}".rstrip("0").rstrip(".")
    return f"Of {comparisons} comparisons without any real difference, about {about} would pass."


def _left_out(pairs: Sequence[tuple[str, str]], of: Sequence[tuple[str, str]]) -> str:
    if len(pairs) == len(of):
        return ""
    return f"The first {len(pairs)} of {len(of)} pairs; a report of fewer runs has the others."


def _difference_row(
    grids: Sequence[Grid], first: str, second: str, condition: Condition, bootstrap: Bootstrap
) -> tuple[str, ...] | None:
    sides = []
    for grid in grids:
        a, b = grid.cells.get((first, condition)), grid.cells.get((second, condition))
        if a is None or b is None:
            return None
        sides.append(side_by_side(a, b))
    shared = [ours.shape[1] for ours, _ in sides]
    if not all(shared):
        return (f"{first} − {second}", condition.speed, "", "no shared episodes", "", "", "0")
    found = bootstrap.compare(sides)
    p_value = "" if np.isnan(found.p_value) else f"{found.p_value:.3f}"
    p_value = "<0.001" if p_value == "0.000" else p_value
    return (
        f"{first} − {second}",
        condition.speed,
        points(found.difference),
        found.verdict,
        percent(found.improvement),
        p_value,
        str(sum(shared)),
    )
