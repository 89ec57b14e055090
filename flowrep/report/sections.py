"""The sections of a report on runs: headings, figures and tables, and their files."""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from flowrep.report.figures import draw_bars, draw_curves, draw_rates, encoded, words
from flowrep.report.runs import (
    BASELINES,
    COMPLEMENTARY_STACKS,
    FLOW_STACKS,
    SPEEDS,
    STACKS,
    Condition,
    Grid,
    Group,
    Run,
    change,
    curve_of,
    grid_of,
    groups_of,
    in_order,
    in_stacks,
    out_of_bounds_of_both,
    pooled,
    scenes_of,
    side_by_side,
)
from flowrep.report.statistics import FEWEST_RUNS, Bootstrap, Comparison, Estimate, holm
from flowrep.report.tables import MISSING, Table, listed, p_text, percent, points, ratio

INTERVALS = (
    "the mean over seeds with 95 % intervals, by a bootstrap over seeds and episodes; of a single "
    "seed, or where all resamples agree, Wilson's over the episodes"
)
_MOST_PAIRS = 15  # in a table
_LONGEST_LABEL = 30  # of a config, in a legend
_ALL = "ego+obj+seg2+depth2"

# The paper's comparisons: name, title, stacks, and differences (first, second).
_OF_FLOWS = (("ego+obj", "ego"), ("ego+obj", "raw"), ("ego+obj", "obj"), ("raw", "ego"))
_OF_ADDED = (
    ("ego+obj+seg2", "seg2"), ("ego+obj+depth2", "depth2"), ("ego+obj+seg2", "ego+obj"),
    ("ego+obj+depth2", "ego+obj"), (_ALL, "ego+obj"), ("ego+obj", "seg2"), ("ego+obj", "depth2"),
)  # fmt: skip
_EXPERIMENTS = (
    ("flow_composition", "Composition of the flow maps", FLOW_STACKS, _OF_FLOWS),
    ("complementary", "Flow beside segmentation and depth", COMPLEMENTARY_STACKS, _OF_ADDED),
)
_TABLE_III = ("ego+obj", "depth2", "seg2", "ego+obj+depth2", "ego+obj+seg2", _ALL)


class Settings(NamedTuple):
    """A report's choice of evaluations, "greedy" or "sampled", and of intervals."""

    policy: str
    bootstrap: Bootstrap


class Section(NamedTuple):
    """One part of a report: its heading, tables, and figure with a caption."""

    name: str
    title: str
    tables: tuple[Table, ...] = ()
    figure: Figure | None = None
    caption: str = ""
    label: str = ""  # what distinguishes the config of its runs from other sections'
    folder: str = ""  # of its files


class Report(NamedTuple):
    """What a page shows of runs, except their drives."""

    runs: tuple[Run, ...]
    warnings: tuple[str, ...]
    sections: tuple[Section, ...]


def assemble(runs: Sequence[Run], warnings: Sequence[str], settings: Settings) -> Report:
    """Returns the sections for runs, group by group, and the problems found in runs."""
    groups = groups_of(runs)
    wrong = [*warnings, *(w for w in (_unusable(run, settings) for run in runs) if w)]
    sections = []
    for number, group in enumerate(groups, start=1):
        prefix = f"{number}_" if len(groups) > 1 else ""
        for section in _group_sections(group, settings):
            sections.append(section._replace(folder=prefix + section.name, label=group.label))
    if len(groups) > 1:
        sections.append(_configs_section(groups, settings)._replace(folder="configs"))
    return Report(tuple(runs), tuple(wrong), tuple(sections))


def write_files(report: Report, folder: Path) -> list[Path]:
    """Writes figures as PNG and PDF, tables as LaTeX and CSV; returns the sections' folders."""
    for section in report.sections:
        place = folder / section.folder
        place.mkdir(exist_ok=True)
        if section.figure:
            for kind in ("png", "pdf"):
                (place / f"{section.name}.{kind}").write_bytes(encoded(section.figure, kind))
        for table in section.tables:
            (place / f"{table.name}.tex").write_text(table.to_latex(), encoding="utf-8")
            (place / f"{table.name}.csv").write_text(table.to_csv(), encoding="utf-8")
    return [folder / section.folder for section in report.sections]


def _unusable(run: Run, settings: Settings) -> str | None:
    """Returns why a run fills no cell, None if it does."""
    policy, unused = settings.policy, "only its learning curve is used"
    if not run.is_finished:
        reached = f"{run.frames:,} of {run.total_frames:,} frames"
        return f"{run.name} is not finished, at {reached}: {unused}"
    if policy not in {condition.policy for condition in run.conditions}:
        remedy = f"python -m flowrep.evaluate run={run.name} policy={policy} adds one"
        return f"{run.name} has no {policy} evaluation at its end: {unused}; {remedy}"
    return None


def _group_sections(group: Group, settings: Settings) -> list[Section]:
    runs = [run for run in group.runs if _unusable(run, settings) is None]
    if not runs:
        return _curves(group.runs)
    found = in_stacks(runs)
    sections, shown = [], set[str]()
    for name, title, stacks, pairs in _EXPERIMENTS:
        if len({*found} & {*stacks}) > 1:
            series = {stack: found.get(stack, []) for stack in stacks}
            sections.append(_success_section(name, title, series, pairs, settings))
            shown |= {*stacks}
    if {*found} - shown:
        every = list(combinations(reversed(found), 2))
        sections.append(_success_section("success", "Success", found, every, settings))
    sections.append(_failure_section(runs, settings))
    if len(_rates(runs, settings.policy)) > 1:
        sections.append(_rate_section(runs, settings))
    return [*sections, *_curves(group.runs)]


# Runs of a group differ in scene, stack and seed alone: the first one's speed and frame rate are
# those of all.
def _rates(runs: Sequence[Run], policy: str) -> list[float]:
    asked = (policy, runs[0].speed)
    return sorted({c.fps for run in runs for c in run.conditions if c[:2] == asked})


def _at_speeds(runs: Sequence[Run], policy: str) -> list[Condition]:
    fps = runs[0].fps
    driven = [c.speed for run in runs for c in run.conditions if c[::2] == (policy, fps)]
    return [Condition(policy, speed, fps) for speed in in_order(driven, SPEEDS)]


def _success_section(
    name: str,
    title: str,
    series: Mapping[str, Sequence[Run]],
    pairs: Sequence[tuple[str, str]],
    settings: Settings,
    baselines: Sequence[str] = BASELINES,
) -> Section:
    runs = [run for members in series.values() for run in members]
    policy, bootstrap = settings
    conditions = _at_speeds(runs, policy)
    grids = [grid_of(s, series, conditions, bootstrap, baselines) for s in scenes_of(runs)]
    trained = listed(sorted({run.speed for run in runs}))
    caption = (
        f"Success of agents trained at {trained} speed, {policy} actions, {runs[0].fps:g} frames "
        f"per second: {INTERVALS}; dots are the seeds."
    )
    tables = [_success_table(name, grids, caption, bootstrap)]
    tables += _difference_tables(name, grids, pairs, bootstrap)
    return Section(name, title, tuple(tables), draw_bars(grids), caption)


def _shares(grid: Grid, series: str) -> list[str]:
    cells = [grid.cells.get((series, c)) for c in grid.conditions]
    return [percent(cell.score) if cell else MISSING for cell in cells]


def _success_table(name: str, grids: Sequence[Grid], caption: str, bootstrap: Bootstrap) -> Table:
    _, series, conditions, *_ = grids[0]
    blocks = []
    for grid in grids:
        rows = []
        for one in series:
            cells = [grid.cells[one, c] for c in conditions if (one, c) in grid.cells]
            counts = dict.fromkeys(cell.matrix.counts for cell in cells)
            rows.append((one, *_shares(grid, one), ", ".join(counts) or "0"))
        for baseline in dict.fromkeys(baseline for baseline, _ in grid.baselines):
            shares = [grid.baselines.get((baseline, c)) for c in conditions]
            texts = [MISSING if share is None else f"{100 * share:.0f}" for share in shares]
            rows.append((baseline.replace("_", " "), *texts, ""))
        blocks.append((words(grid.scene), tuple(rows)))
    if len(grids) > 1:

        def over_all(place: tuple[str, Condition]) -> str:
            found = [g.cells[place].matrix.outcomes for g in grids if place in g.cells]
            return percent(bootstrap.success(found)) if len(found) == len(grids) else MISSING

        rows = [(one, *(over_all((one, c)) for c in conditions), "") for one in series]
        blocks.append((f"All {len(grids)} scenes", tuple(rows)))
    header = ("representations", *(f"{c.speed} (%)" for c in conditions), "seeds × episodes")
    return Table(f"{name}_success", f"In %. {caption}", header, tuple(blocks))


def _difference_tables(
    name: str, grids: Sequence[Grid], pairs: Sequence[tuple[str, str]], bootstrap: Bootstrap
) -> list[Table]:
    chosen = pairs[:_MOST_PAIRS]
    places = [(words(grid.scene), [grid]) for grid in grids]
    if len(grids) > 1:
        places.append((f"All {len(grids)} scenes", list(grids)))
    blocks = []
    for heading, members in places:
        found = [
            (f"{first} − {second}", c.speed, *compared)
            for (first, second), c in product(chosen, grids[0].conditions)
            if (compared := _compared(members, (first, c), (second, c), bootstrap)) is not None
        ]
        corrected = holm([c.p_value for _, _, c, _ in found])
        rows = []
        for (pair, speed, c, shared), p in zip(found, corrected):
            cells = (points(c.difference), c.verdict(p), percent(c.improvement))
            rows.append((pair, speed, *cells, p_text(c.p_value), p_text(p), str(shared)))
        if rows:
            blocks.append((heading, tuple(rows)))
    caption = (
        "First minus second in percentage points, on the episodes that all runs of both drove, "
        "with 95 % bootstrap intervals over seeds and episodes; the probability that a run of the "
        "first beats one of the second (a tie counts half); p of Welch's t-test over seeds, and "
        "corrected by Holm for the comparisons of its block. A difference is told from noise where "
        "its interval leaves out 0 and the corrected p < 0.05; of fewer than "
        f"{FEWEST_RUNS} seeds a side it is one of these agents."
    )
    if len(chosen) < len(pairs):
        caption += f" The first {len(chosen)} of {len(pairs)} pairs."
    columns = ("speed", "points", "verdict", "P(first better) (%)", "p", "p (Holm)", "shared")
    header = ("first − second", *columns)
    return [Table(f"{name}_differences", caption, header, tuple(blocks), (1, 3))] if blocks else []


def _compared(
    grids: Sequence[Grid],
    first: tuple[str, Condition],
    second: tuple[str, Condition],
    bootstrap: Bootstrap,
) -> tuple[Comparison, int] | None:
    # A comparison over scenes, and the number of its episodes; None where a side has none.
    if not all({first, second} <= {*grid.cells} for grid in grids):
        return None
    sides = [side_by_side(grid.cells[first].matrix, grid.cells[second].matrix) for grid in grids]
    shared = [ours.shape[1] for ours, _ in sides]
    return (bootstrap.compare(sides), sum(shared)) if all(shared) else None


def _failure_section(runs: Sequence[Run], settings: Settings) -> Section:
    # The paper's Table III, which is of low and high speed together.
    fps, driven = runs[0].fps, {c.speed for c in _at_speeds(runs, settings.policy)}
    speeds = ["low", "high"] if {"low", "high"} <= driven else [runs[0].speed]
    conditions = [Condition(settings.policy, speed, fps) for speed in speeds]
    stacks = in_order([run.stack for run in runs], _TABLE_III)
    blocks = []
    for scene in in_order(scenes_of(runs), ("s_turn",)):
        here = in_stacks([run for run in runs if run.scene == scene])
        rows = [(s, *_failure_cells(here.get(s, []), conditions, settings)) for s in stacks]
        blocks.append((words(scene), tuple(rows)))
    caption = (
        "Causes of failure in % of collisions and departures from the road together, of all seeds; "
        "time-outs are left out. 95 % intervals by a bootstrap over seeds and episodes, of a "
        f"single seed Wilson's. {words(' and '.join(speeds))} speed, {fps:g} frames per second, "
        f"{settings.policy} actions."
    )
    header = ("representations", "out of bounds (%)", "collision (%)", "out of bounds to collision")
    counts = ("failures", "time-outs", "episodes")
    table = Table("failure_causes", caption, (*header, *counts), tuple(blocks))
    return Section("failure_causes", "Causes of failure", (table,))


def _failure_cells(
    runs: Sequence[Run], conditions: Sequence[Condition], settings: Settings
) -> tuple[str, ...]:
    outcomes = pooled(runs, conditions, out_of_bounds_of_both)
    timeouts = pooled(runs, conditions, lambda ends: (ends == "timeout").astype(float))
    if outcomes is None or timeouts is None:
        return (*[MISSING] * 3, "0", "0", "0")
    share = settings.bootstrap.pooled_share(outcomes)
    counts = ((~np.isnan(outcomes)).sum(), np.nansum(timeouts), (~np.isnan(timeouts)).sum())
    counted = tuple(str(int(number)) for number in counts)
    if np.isnan(share.value):
        return (*["no failures"] * 3, *counted)
    collisions = Estimate(1 - share.value, 1 - share.high, 1 - share.low)
    return (percent(share, 1), percent(collisions, 1), ratio(share), *counted)


def _rate_section(runs: Sequence[Run], settings: Settings) -> Section:
    policy, speed, trained = settings.policy, runs[0].speed, runs[0].fps
    ours = [run for run in runs if len(_rates([run], policy)) > 1]
    conditions = [Condition(policy, speed, rate) for rate in _rates(ours, policy)]
    low, high = conditions[0], conditions[-1]
    series = in_stacks(ours)
    grids = [grid_of(scene, series, conditions, settings.bootstrap) for scene in scenes_of(ours)]
    blocks = []
    for grid in grids:
        rows = []
        for name, members in series.items():
            changes = change([run for run in members if run.scene == grid.scene], high, low)
            lost = MISSING if changes is None else points(settings.bootstrap.mean([changes]))
            rows.append((name, *_shares(grid, name), lost))
        blocks.append((words(grid.scene), tuple(rows)))
    caption = (
        f"Success over the frame rate of the evaluation, trained at {trained:g} frames per second, "
        f"{speed} speed, {policy} actions: {INTERVALS}. Points of one rate stand side by side."
    )
    heads = (*(f"{c.fps:g} Hz (%)" for c in conditions), f"{high.fps:g} → {low.fps:g} Hz (points)")
    said = f"In %. {caption} The last column is the change of the same agents on the same episodes."
    table = Table("frame_rate_success", said, ("representations", *heads), tuple(blocks))
    title = "Sensitivity to the frame rate"
    return Section("frame_rate", title, (table,), draw_rates(grids), caption)


def _curves(runs: Sequence[Run]) -> list[Section]:
    panels = []
    for scene in scenes_of(runs):
        here = [run for run in runs if run.scene == scene]
        curves = {stack: [curve_of(run) for run in of] for stack, of in in_stacks(here).items()}
        if any(curve.evaluated or curve.training for of in curves.values() for curve in of):
            panels.append((scene, curves))
    if not panels:
        return []
    caption = (
        "Learning curves. Bold, with markers: greedy evaluations at the training speed, the mean "
        "over seeds. Thin: each seed's training episodes, sampled actions."
    )
    return [Section("learning_curves", "Learning curves", (), draw_curves(panels), caption)]


def _configs_section(groups: Sequence[Group], settings: Settings) -> Section:
    # Stacks that have runs of several configs, side by side and never pooled.
    keys = dict.fromkeys(key for group in groups for key in group.differences)
    labels = [group.label for group in groups]
    are_short = all(0 < len(label) <= _LONGEST_LABEL for label in labels)
    configs = labels if are_short else [f"config {n}" for n in range(1, len(groups) + 1)]
    rows = [(key, *(group.differences.get(key, "")[:60] for group in groups)) for key in keys]
    caption = "Keys of the configs in which the runs differ. No number is of runs of two columns."
    columns = tuple(range(1, len(groups) + 1))
    table = Table("configs", caption, ("key", *configs), (("", tuple(rows)),), columns)

    series: dict[tuple[str, str], list[Run]] = {}  # of a stack and a config
    usable = [[run for run in g.runs if _unusable(run, settings) is None] for g in groups]
    places = Counter(place for runs in usable for place in {(r.scene, r.stack) for r in runs})
    shared = [place for place, configs_there in places.items() if configs_there > 1]
    for stack in in_order([stack for _, stack in shared], STACKS):
        for config, runs in zip(configs, usable):
            here = [r for r in runs if r.stack == stack and (r.scene, stack) in shared]
            series |= {(stack, config): here} if here else {}
    if not series:
        return Section("configs", "Configs that differ", (table,))
    named = {", ".join(place): runs for place, runs in series.items()}
    pairs = [(", ".join(b), ", ".join(a)) for a, b in combinations(series, 2) if a[0] == b[0]]
    section = _success_section("configs", "Configs that differ", named, pairs, settings, ())
    return section._replace(tables=(table, *section.tables))
