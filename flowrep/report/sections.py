"""The sections of a report on runs: which headings, figures and tables, and their files."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from flowrep.config.cli import line_for
from flowrep.files import refuse_link, replace_bytes, replace_text
from flowrep.report.cell_text import listed
from flowrep.report.figures import draw_bars, draw_curves, draw_rates, encoded
from flowrep.report.runs import (
    COMPLEMENTARY_STACKS,
    FLOW_STACKS,
    SPEEDS,
    Condition,
    Group,
    Run,
    curve_of,
    grid_of,
    groups_of,
    in_order,
    in_stacks,
    scenes_of,
)
from flowrep.report.tables import (
    INTERVALS,
    Table,
    differences_table,
    failure_table,
    rate_table,
    success_table,
)

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
    """Writes figures as PNG and PDF, tables as CSV; returns the sections' folders.

    Of the files of an earlier report, which `files.txt` lists, those that it lacks are removed.
    """
    contents: dict[str, bytes] = {}
    for section in report.sections:
        if section.figure:
            for kind in ("png", "pdf"):
                contents[f"{section.folder}/{section.name}.{kind}"] = encoded(section.figure, kind)
        for table in section.tables:
            contents[f"{section.folder}/{table.name}.csv"] = table.to_csv().encode()
    for name, data in contents.items():
        refuse_link((folder / name).parent).mkdir(exist_ok=True)
        replace_bytes(folder / name, data)
    listing = folder / "files.txt"
    listed = listing.read_text("utf-8").splitlines() if listing.is_file() else []
    for name in {*listed} - {*contents}:
        # In a stranger's folder, the list may name any file.
        if re.fullmatch(r"\w+/\w+\.(png|pdf|csv)", name):
            refuse_link((folder / name).parent)
            (folder / name).unlink(missing_ok=True)
            with suppress(OSError):  # it holds other files
                (folder / name).parent.rmdir()
    replace_text(listing, "".join(f"{name}\n" for name in contents))
    return [folder / section.folder for section in report.sections]


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
    table = success_table(name, grids, caption)
    differences = differences_table(name, series, scenes, conditions, pairs)
    tables = (table, differences) if differences.blocks else (table,)
    return ReportSection(name, title, tables, draw_bars(grids), caption)


def _failure_section(runs: Sequence[Run], policy: str) -> ReportSection:
    # The paper's Table III is of low and high speed together.
    fps, driven = runs[0].fps, {c.speed for c in _conditions_by_speed(runs, policy)}
    speeds = ["low", "high"] if {"low", "high"} <= driven else [runs[0].speed]
    table = failure_table(runs, [Condition(policy, speed, fps) for speed in speeds])
    return ReportSection("failure_causes", "Causes of failure", (table,))


def _rate_section(runs: Sequence[Run], policy: str) -> ReportSection:
    speed, trained = runs[0].speed, runs[0].fps
    ours = [run for run in runs if len(_frame_rates([run], policy)) > 1]
    conditions = [Condition(policy, speed, rate) for rate in _frame_rates(ours, policy)]
    series = in_stacks(ours)
    grids = [grid_of(scene, series, conditions) for scene in scenes_of(ours)]
    caption = (
        f"Success by frame rate of the evaluation, trained at {trained:g} frames per second, "
        f"{speed} speed, {policy} actions: {INTERVALS}. Points at one rate are side by side."
    )
    table = rate_table(grids, series, caption)
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
