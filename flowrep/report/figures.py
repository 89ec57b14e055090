"""The figures: grouped bars and lines over frame rates, with intervals and their own legend."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from flowrep.report.results import Grid, Score
from flowrep.report.style import COLUMN_IN, PAGE_IN, Theme, looks, styled, words

_BASELINE_LINES: dict[str, Any] = {"never_turn": ":", "random": "-.", "planner": "--"}
_BASELINE_NAMES = {"never_turn": "never turns", "random": "random", "planner": "planner"}
_PAPER_PT, _PAGE_PT = 7.5, 10.0
_MOST_IN_A_ROW = 4  # panels
_WIDEST_BAR = 0.3  # of a group


def canvas(panels: int, theme: Theme, *, for_page: bool) -> tuple[Figure, list[Axes]]:
    """Returns a figure with panels in rows, sized for a paper or for a web page."""
    columns = min(panels, _MOST_IN_A_ROW)
    rows = -(-panels // columns)
    if for_page:
        width, height = 5.6, 3.7
    else:
        width = COLUMN_IN if panels == 1 else PAGE_IN
        height = 2.3 if panels == 1 else 2.1
    figure = Figure(figsize=(width, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel().tolist()
    for spare in axes[panels:]:
        spare.set_visible(False)
    return figure, axes[:panels]


def style_for(theme: Theme, *, for_page: bool) -> Any:
    """Returns the context in which a figure is drawn."""
    return styled(theme, _PAGE_PT if for_page else _PAPER_PT)


def draw_bars(grids: Sequence[Grid], theme: Theme, *, for_page: bool = False) -> Figure:
    """Returns grouped bars: a panel per scene, a group per speed mode, a bar per stack.

    Whiskers are the intervals, small dots the seeds, dotted lines the baselines.
    """
    with style_for(theme, for_page=for_page):
        figure, panels = canvas(len(grids), theme, for_page=for_page)
        for axes, grid in zip(panels, grids):
            _bars(axes, grid, theme)
            axes.set_title(words(grid.scene))
        percent_axis(panels)
        shown = {name for grid in grids for name, _ in grid.baselines}
        legend(figure, _bar_handles(grids[0].series, shown, theme))
    return figure


def _bars(axes: Axes, grid: Grid, theme: Theme) -> None:
    style = looks(grid.series, theme)
    width = min(0.84 / len(grid.series), _WIDEST_BAR)
    for group, condition in enumerate(grid.conditions):
        for place, name in enumerate(grid.series):
            at = group + (place - (len(grid.series) - 1) / 2) * width
            score = grid.scores[name, condition]
            if score is None:
                axes.text(
                    at, 1.5, "missing", rotation=90, ha="center", va="bottom", color=theme.faint,
                    fontsize="x-small",
                )  # fmt: skip
                continue
            look = style[name]
            axes.bar(
                at, 100 * score.estimate.value, 0.92 * width, facecolor=look.colour,
                hatch=look.hatch, edgecolor=theme.ground if look.hatch else theme.text, linewidth=0,
            )  # fmt: skip
            _whisker(axes, at, width, score, theme)
        for name, line in _BASELINE_LINES.items():
            share = grid.baselines.get((name, condition))
            if share is not None:
                ends = [group - 0.46, group + 0.46]
                axes.plot(ends, [100 * share] * 2, line, color=theme.text, linewidth=1.0)
    axes.set_xticks(range(len(grid.conditions)), [c.speed for c in grid.conditions])
    axes.set_xlim(-0.5, len(grid.conditions) - 0.5)
    axes.set_xlabel("pedestrians' speed mode")
    axes.tick_params(axis="x", length=0)


def _whisker(axes: Axes, at: float, width: float, score: Score, theme: Theme) -> None:
    value, low, high = (100 * number for number in score.estimate)
    axes.errorbar(
        at, value, [[max(value - low, 0)], [max(high - value, 0)]], color=theme.text,
        linewidth=0.9, capsize=1.8, capthick=0.9, clip_on=False,
    )  # fmt: skip
    if len(score.of_seeds) > 1:
        dots = [100 * share for share in score.of_seeds]
        offset = [at + 0.24 * width] * len(dots)
        ring: Any = {"facecolor": theme.ground, "edgecolor": theme.text, "linewidth": 0.5}
        axes.scatter(offset, dots, s=5, zorder=4, clip_on=False, **ring)


def _bar_handles(series: Sequence[str], baselines: set[str], theme: Theme) -> list[Any]:
    handles: list[Any] = [
        Patch(facecolor=look.colour, hatch=look.hatch, edgecolor=theme.ground, lw=0, label=name)
        for name, look in looks(series, theme).items()
    ]
    handles += [
        Line2D([], [], linestyle=line, color=theme.text, linewidth=1.0, label=_BASELINE_NAMES[name])
        for name, line in _BASELINE_LINES.items()
        if name in baselines
    ]
    return handles


def draw_rates(grids: Sequence[Grid], theme: Theme, *, for_page: bool = False) -> Figure:
    """Returns success over frame rates: a panel per scene, a line per stack, named at its end."""
    with style_for(theme, for_page=for_page):
        figure, panels = canvas(len(grids), theme, for_page=for_page)
        for axes, grid in zip(panels, grids):
            _rate_lines(axes, grid, theme)
            axes.set_title(words(grid.scene))
        percent_axis(panels)
        legend(figure, line_handles(grids[0].series, theme))
    return figure


def _rate_lines(axes: Axes, grid: Grid, theme: Theme) -> None:
    style = looks(grid.series, theme)
    at = [condition.fps for condition in grid.conditions]
    step = min((b - a for a, b in pairwise(at)), default=1.0)
    for place, name in enumerate(grid.series):
        # side by side, so that whiskers of equal scores are all visible
        aside = (place - (len(grid.series) - 1) / 2) * 0.08 * step
        found = [(c.fps + aside, grid.scores[name, c]) for c in grid.conditions]
        points = [(x, score.estimate) for x, score in found if score is not None]
        if not points:
            continue
        xs, values = [x for x, _ in points], [100 * e.value for _, e in points]
        below = [max(100 * (e.value - e.low), 0) for _, e in points]
        above = [max(100 * (e.high - e.value), 0) for _, e in points]
        look = style[name]
        axes.errorbar(
            xs, values, [below, above], color=look.colour, linestyle=look.dashes,
            marker=look.marker, markersize=3.5, linewidth=1.3, elinewidth=0.9, capsize=1.8,
            clip_on=False,
        )  # fmt: skip
    axes.set_xticks(at, [f"{rate:g}" for rate in at])
    axes.set_xlabel("frames a second (Hz)")


def line_handles(series: Sequence[str], theme: Theme) -> list[Any]:
    """Returns a legend's entries for lines."""
    return [
        Line2D(
            [], [], color=look.colour, marker=look.marker, markersize=3.5, linestyle=look.dashes,
            linewidth=1.3, label=name,
        )
        for name, look in looks(series, theme).items()
    ]  # fmt: skip


def percent_axis(panels: Sequence[Axes]) -> None:
    """Gives panels one axis of success in percent."""
    for axes in panels:
        axes.set_ylim(0, 100)
        axes.set_yticks(range(0, 101, 25))
        axes.grid(axis="y")
        axes.set_axisbelow(True)
    panels[0].set_ylabel("success (% of episodes)")


def legend(figure: Figure, handles: Sequence[Any]) -> None:
    """Puts a legend above the panels, in reading order."""
    em_in = mpl.rcParams["font.size"] / 72
    longest = max(len(handle.get_label()) for handle in handles)
    entry_in = (0.5 * longest + 3.5) * em_in  # half an em a letter, 3.5 for the sign and gaps
    columns = min(len(handles), max(1, int(figure.get_figwidth() / entry_in)))
    by_column = [handle for start in range(columns) for handle in handles[start::columns]]
    figure.legend(
        handles=by_column, loc="outside upper center", ncols=columns, handlelength=1.8,
        columnspacing=1.2, handletextpad=0.5,
    )  # fmt: skip
