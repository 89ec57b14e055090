"""The sections of a report on runs: headings, figures and tables, and their files."""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from flowrep.config.cli import line_for
from flowrep.files import refuse_link, replace_bytes, replace_text
from flowrep.report.figures import draw_bars, draw_curves, draw_rates, encoded, words
from flowrep.report.runs import (
    COMPLEMENTARY_STACKS,
    FLOW_STACKS,
    SPEEDS,
    Condition,
    Group,
    Run,
    SuccessGrid,
    changes,
    curve_of,
    departures,
    grid_of,
    groups_of,
    in_order,
    in_stacks,
    paired_scores,
    scenes_of,
    scores_of,
)
from flowrep.report.statistics import Estimate, effect, holm, improvement, mean_share
from flowrep.report.tables import MISSING, Table, listed, p_text, percent, points, ratio

INTERVALS = (
    "the mean over seeds with its 95 % t interval; for a single seed, or seeds with equal rates, "
    "Wilson's interval over the episodes"
)
_MOST_PAIRS = 15  # in a table
_ALL = "ego+obj+seg2+depth2"

# The paper's comparisons: name, title, stacks, and differences (first, second).
_FLOW_PAIRS = (("ego+obj", "ego"), ("ego+obj", "raw"), ("ego+obj", "obj"), ("raw", "ego"))
_ADDED_PAIRS = (
    ("ego+obj+seg2", "seg2"), ("ego+obj+depth2", "depth2"), ("ego+obj+seg2", "ego+obj"),
    ("ego+obj+depth2", "ego+obj"), (_ALL, "ego+obj"), ("ego+obj", "seg2"), ("ego+obj", "depth2"),
)  # fmt: skip
_EXPERIMENTS = (
    ("flow_composition", "Composition of the flow maps", FLOW_STACKS, _FLOW_PAIRS),
    ("complementary", "Flow with segmentation and depth", COMPLEMENTARY_STACKS, _ADDED_PAIRS),
)
_TABLE_III = ("ego+obj", "depth2", "seg2", "ego+obj+depth2", "ego+obj+seg2", _ALL)


class ReportSection(NamedTuple):
    """One part of a report: its heading, its tables, and a figure with a caption."""

    name: str
    title: str
    tables: tuple[Table, ...] = ()
    figure: Figure | None = None
    caption: str = ""
    label: str = ""  # how the config of its runs differs from other sections'
    folder: str = ""  # of its files, and its id in the page


class Report(NamedTuple):
    """What a page shows of runs."""

    runs: tuple[Run, ...]
    warnings: tuple[str, ...]
    sections: tuple[ReportSection, ...]


def assemble(runs: Sequence[Run], warnings: Sequence[str], policy: str = "greedy") -> Report:
    """Returns the sections for runs, group by group, and warnings about runs.

    Args:
        policy: whose evaluations are counted, "greedy" or "sampled".
    """
    groups = groups_of(runs)
    unused = filter(None, (_why_unused(run, policy) for run in runs))
    sections = []
    # Folders are numbered only if there are several groups, so that the usual paths stay short.
    for number, group in enumerate(groups, start=1):
        prefix = f"{number}_" if len(groups) > 1 else ""
        for section in _group_sections(group, policy):
            sections.append(section._replace(folder=prefix + section.name, label=group.label))
    return Report(tuple(runs), (*warnings, *unused), tuple(sections))


def write_files(report: Report, folder: Path) -> list[Path]:
    """Writes figures as PNG and PDF, tables as CSV; returns the sections' folders."""
    folders = [folder / section.folder for section in report.sections]
    for section, path in zip(report.sections, folders):
        refuse_link(path).mkdir(exist_ok=True)
        if section.figure:
            for kind in ("png", "pdf"):
                replace_bytes(path / f"{section.name}.{kind}", encoded(section.figure, kind))
        for table in section.tables:
            replace_text(path / f"{table.name}.csv", table.to_csv())
    return folders


def _why_unused(run: Run, policy: str) -> str | None:
    """Returns why a run is in no table, None if it is in one."""
    unused = "only its learning curve is used"
    if not run.is_trained:
        reached = f"{run.frames:,} of {run.total_frames:,} frames"
        return f"{run.name} is not trained to the end, at {reached}: {unused}"
    driven = {condition.policy for condition in run.conditions}
    if policy not in driven:
        remedy = ""
        if run.folder is not None:
            remedy = f"; {line_for('evaluate', run=run.name, policy=policy)} adds one"
        for other in driven & {"greedy", "sampled"}:
            remedy += f"; a report with policy={other} has the one that there is"
        return f"{run.name} has no final {policy} evaluation: {unused}{remedy}"
    return None


def _group_sections(group: Group, policy: str) -> list[ReportSection]:
    runs = [run for run in group.runs if _why_unused(run, policy) is None]
    if not runs:
        return _curves(group.runs)
    by_stack = in_stacks(runs)
    sections, shown = [], set[str]()
    for name, title, stacks, pairs in _EXPERIMENTS:
        if len({*by_stack} & {*stacks}) > 1:
            series = {stack: by_stack[stack] for stack in stacks if stack in by_stack}
            sections.append(_success_section(name, title, series, pairs, policy))
            shown |= {*stacks}
    if {*by_stack} - shown:
        every = list(combinations(reversed(by_stack), 2))
        sections.append(_success_section("success", "Success", by_stack, every, policy))
    sections.append(_failure_section(runs, policy))
    if any(len(_frame_rates([run], policy)) > 1 for run in runs):
        sections.append(_rate_section(runs, policy))
    return [*sections, *_curves(group.runs)]


# Runs of a group differ only in scene, stack and seed, so all have the first run's speed and frame
# rate.
def _frame_rates(runs: Sequence[Run], policy: str) -> list[float]:
    asked = (policy, runs[0].speed)
    return sorted({c.fps for run in runs for c in run.conditions if c[:2] == asked})


def _conditions_by_speed(runs: Sequence[Run], policy: str) -> list[Condition]:
    fps = runs[0].fps
    driven = [c.speed for run in runs for c in run.conditions if c[::2] == (policy, fps)]
    return [Condition(policy, speed, fps) for speed in in_order(driven, SPEEDS)]


def _success_section(
    name: str,
    title: str,
    series: Mapping[str, Sequence[Run]],
    pairs: Sequence[tuple[str, str]],
    policy: str,
) -> ReportSection:
    runs = [run for members in series.values() for run in members]
    conditions, scenes = _conditions_by_speed(runs, policy), scenes_of(runs)
    grids = [grid_of(scene, series, conditions) for scene in scenes]
    trained = listed(sorted({run.speed for run in runs}))
    caption = (
        f"Success of agents trained at {trained} speed, {policy} actions, {runs[0].fps:g} frames "
        f"per second: {INTERVALS}; dots are the seeds."
    )
    table = _success_table(name, grids, caption)
    differences = _differences_table(name, series, scenes, conditions, pairs)
    tables = (table, differences) if differences.blocks else (table,)
    return ReportSection(name, title, tables, draw_bars(grids), caption)


def _shares(grid: SuccessGrid, series: str) -> list[str]:
    cells = [grid.cells.get((series, c)) for c in grid.conditions]
    return [percent(cell.score) if cell else MISSING for cell in cells]


def _success_table(name: str, grids: Sequence[SuccessGrid], caption: str) -> Table:
    _, series, conditions, *_ = grids[0]
    blocks = []
    for grid in grids:
        rows = []
        for one in series:
            cells = [grid.cells[one, c] for c in conditions if (one, c) in grid.cells]
            counts = dict.fromkeys(cell.counts for cell in cells)
            rows.append((one, *_shares(grid, one), ", ".join(counts) or "0"))
        for baseline in dict.fromkeys(baseline for baseline, _ in grid.baselines):
            shares = [grid.baselines.get((baseline, c)) for c in conditions]
            texts = [MISSING if share is None else f"{100 * share:.0f}" for share in shares]
            rows.append((baseline.replace("_", " "), *texts, ""))
        blocks.append((words(grid.scene), tuple(rows)))
    # A mean over scenes needs every scene: without the hard ones, a stack would look better.
    if len(grids) > 1:

        def over_all(key: tuple[str, Condition]) -> str:
            rates = [grid.cells[key].rates for grid in grids if key in grid.cells]
            return percent(mean_share(rates)) if len(rates) == len(grids) else MISSING

        rows = [(one, *(over_all((one, c)) for c in conditions), "") for one in series]
        blocks.append((f"All {len(grids)} scenes", tuple(rows)))
    header = ("representations", *(f"{c.speed} (%)" for c in conditions), "seeds × episodes")
    return Table(f"{name}_success", f"In %. {caption}", header, tuple(blocks))


def _differences_table(
    name: str,
    series: Mapping[str, Sequence[Run]],
    scenes: Sequence[str],
    conditions: Sequence[Condition],
    pairs: Sequence[tuple[str, str]],
) -> Table:
    asked = [pair for pair in pairs if {*pair} <= {*series}]
    chosen = asked[:_MOST_PAIRS]
    headings = {words(scene): [scene] for scene in scenes}
    if len(scenes) > 1:
        headings[f"All {len(scenes)} scenes"] = list(scenes)
    blocks = []
    for heading, here in headings.items():
        scored = {}  # of each pair and speed, by scene: rates of both sides, number of episodes
        for pair, condition in product(chosen, conditions):
            sides = [[[r for r in series[s] if r.scene == scene] for s in pair] for scene in here]
            of_scenes = [paired_scores(of, [condition]) for of in sides]
            if None not in of_scenes:
                scored[pair, condition.speed] = list(filter(None, of_scenes))
        rates = [[both for both, _ in of_scenes] for of_scenes in scored.values()]
        effects = list(map(effect, rates))
        # One family a block: whoever reads a scene's table sees all of its comparisons at once.
        corrected = holm([each.p_value for each in effects])
        rows = []
        for (pair, speed), each, both, p in zip(scored, effects, rates, corrected):
            shared = sum(number for _, number in scored[pair, speed])
            cells = (points(each.interval()), each.verdict(p), p_text(each.p_value), p_text(p))
            better = f"{100 * improvement(both):.0f}"
            rows.append((" − ".join(pair), speed, *cells, better, str(shared)))
        blocks += [(heading, tuple(rows))] if rows else []
    caption = (
        "First minus second in percentage points, on the episodes that all runs of both drove, "
        "with 95 % intervals and p of Welch's t-test over seeds; p (Holm) is corrected for the "
        "comparisons of its block, and a difference is significant if it is below 0.05. "
        "P(first better) is how often a run of the first beats one of the second; "
        "a tie counts half."
    )
    if len(chosen) < len(asked):
        caption += f" The first {len(chosen)} of {len(asked)} pairs."
    columns = ("speed", "points", "verdict", "p", "p (Holm)", "P(first better) (%)", "shared")
    header = ("first − second", *columns)
    return Table(f"{name}_differences", caption, header, tuple(blocks), (1, 3))


def _failure_section(runs: Sequence[Run], policy: str) -> ReportSection:
    # The paper's Table III, at low and high speed together.
    fps, driven = runs[0].fps, {c.speed for c in _conditions_by_speed(runs, policy)}
    speeds = ["low", "high"] if {"low", "high"} <= driven else [runs[0].speed]
    conditions = [Condition(policy, speed, fps) for speed in speeds]
    stacks = in_order([run.stack for run in runs], _TABLE_III)
    blocks = []
    # The paper's table is of S-Turn, which therefore comes first.
    for scene in in_order(scenes_of(runs), ("s_turn",)):
        here = in_stacks([run for run in runs if run.scene == scene])
        rows = [(stack, *_failure_cells(here.get(stack, []), conditions)) for stack in stacks]
        blocks.append((words(scene), tuple(rows)))
    caption = (
        "Causes of failure in % of all collisions and departures from the road of a run, "
        f"without time-outs: {INTERVALS}. {words(' and '.join(speeds))} speed, {fps:g} frames per "
        f"second, {policy} actions."
    )
    header = ("representations", "out of bounds (%)", "collision (%)", "out of bounds to collision")
    counts = ("failures", "time-outs", "episodes")
    table = Table("failure_causes", caption, (*header, *counts), tuple(blocks))
    return ReportSection("failure_causes", "Causes of failure", (table,))


def _failure_cells(runs: Sequence[Run], conditions: Sequence[Condition]) -> tuple[str, ...]:
    ours = [run for run in runs if run.conditions.issuperset(conditions)]
    if not ours:
        return (*[MISSING] * 3, "0", "0", "0")
    ends = Counter(str(end) for r in ours for c in conditions for end in r.under(c)["outcome"])
    failures = ends["out_of_bounds"] + ends["collision"]
    counted = (str(failures), str(ends["timeout"]), str(ends.total()))
    shares = scores_of(ours, conditions, departures)
    if not len(shares):
        return (*["no failures"] * 3, *counted)
    # The rate of a run is a share of its failures, of which an average run has so many.
    share = mean_share([shares], failures // len(shares))
    # The rest of the failures: the bounds change places.
    collisions = Estimate(1 - share.value, 1 - share.high, 1 - share.low)
    return (percent(share, 1), percent(collisions, 1), ratio(share), *counted)


def _rate_section(runs: Sequence[Run], policy: str) -> ReportSection:
    speed, trained = runs[0].speed, runs[0].fps
    ours = [run for run in runs if len(_frame_rates([run], policy)) > 1]
    conditions = [Condition(policy, speed, rate) for rate in _frame_rates(ours, policy)]
    low, high = conditions[0], conditions[-1]
    series = in_stacks(ours)
    grids = [grid_of(scene, series, conditions) for scene in scenes_of(ours)]
    blocks = []
    for grid in grids:
        rows = []
        for name, members in series.items():
            lost = changes([run for run in members if run.scene == grid.scene], high, low)
            loss = points(effect([(lost,)]).interval()) if len(lost) else MISSING
            rows.append((name, *_shares(grid, name), loss))
        blocks.append((words(grid.scene), tuple(rows)))
    caption = (
        f"Success by frame rate of the evaluation, trained at {trained:g} frames per second, "
        f"{speed} speed, {policy} actions: {INTERVALS}. Points at one rate are side by side."
    )
    heads = (*(f"{c.fps:g} Hz (%)" for c in conditions), f"{high.fps:g} → {low.fps:g} Hz (points)")
    of_table = f"In %. {caption} The last column is the change of one agent on the same episodes."
    table = Table("frame_rate_success", of_table, ("representations", *heads), tuple(blocks))
    title = "Sensitivity to the frame rate"
    return ReportSection("frame_rate", title, (table,), draw_rates(grids), caption)


def _curves(runs: Sequence[Run]) -> list[ReportSection]:
    panels = []
    for scene in scenes_of(runs):
        here = [run for run in runs if run.scene == scene]
        curves = {stack: [curve_of(run) for run in of] for stack, of in in_stacks(here).items()}
        if any(curve.evaluated or curve.training for of in curves.values() for curve in of):
            panels.append((scene, curves))
    if not panels:
        return []
    caption = (
        "Learning curves. Bold lines with markers: greedy evaluations at the training speed, mean "
        "over seeds. Thin lines: training episodes of each seed, with sampled actions."
    )
    return [ReportSection("learning_curves", "Learning curves", (), draw_curves(panels), caption)]
