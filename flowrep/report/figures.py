"""The figures: bars by speed, lines over frame rates and over training, with intervals.

A stack has one colour in every figure, safe for colour-blind readers. The same data give the same
files, byte for byte.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import cycle, pairwise, product
from typing import Any, NamedTuple, get_args

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from flowrep.config.options import BaselineName
from flowrep.report.runs import SCENES, Curve, SuccessGrid
from flowrep.report.statistics import Estimate

_TEXT, _FAINT = "#1b1f24", "#6b7480"

_TITLES = dict(zip(SCENES, ("Straight Road", "S-Turn", "H-Shaped Pathways", "Three-Way Junction")))
_LINE_STYLES: tuple[Any, ...] = (":", "-.", "--", (0, (6, 2, 1, 2)))
_BASELINE_LINES = dict(zip(get_args(BaselineName), _LINE_STYLES, strict=True))
_COLUMN_IN, _PAGE_IN = 3.5, 7.16  # widths of a paper's column and page (IEEE's two columns)
_MOST_PANELS_IN_A_ROW = 4  # panels
_WIDEST_BAR = 0.3  # as a share of a group
_CAPS: dict[str, Any] = {"capsize": 1.8, "capthick": 0.9, "clip_on": False}  # of whiskers


class Look(NamedTuple):
    """How a series is drawn: its colour, its bars' hatch, its line's marker."""

    colour: str
    hatch: str
    marker: str

    @property
    def line(self) -> dict[str, Any]:
        """The style of its line: dashed where bars are hatched."""
        dashes = "--" if self.hatch else "-"
        return {"color": self.colour, "marker": self.marker, "linestyle": dashes, "markersize": 3.5}


# Okabe and Ito's colours for single maps and for ego + object flow. Flows with another map have a
# darker colour of that map's hue, and a hatch or a dashed line.
_LOOKS = {
    "ego": Look("#e69f00", "", "o"),
    "raw": Look("#56b4e9", "", "s"),
    "obj": Look("#009e73", "", "^"),
    "ego+obj": Look("#0072b2", "", "D"),
    "seg2": Look("#d55e00", "", "v"),
    "depth2": Look("#cc79a7", "", "P"),
    "ego+obj+seg2": Look("#8a3c00", "////", "X"),
    "ego+obj+depth2": Look("#7d3f66", "\\\\\\\\", "*"),
    "ego+obj+seg2+depth2": Look("#4a4a4a", "xxxx", "p"),
}


def looks(stacks: Sequence[str]) -> dict[str, Look]:
    """Returns how the stacks of a figure are drawn: the paper's look the same in all figures."""
    if {*stacks} <= {*_LOOKS}:
        return {stack: _LOOKS[stack] for stack in stacks}
    # Another stack must look like none of the paper's, so all are drawn in turn.
    colours = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
    hatches = ("", "......", "++++", "||||")
    turns = cycle(product(hatches, colours)), cycle(look.marker for look in _LOOKS.values())
    return {
        stack: Look(colour, hatch, marker) for stack, (hatch, colour), marker in zip(stacks, *turns)
    }


def words(name: str) -> str:
    """Returns a name from a config as a heading; the paper's scenes are spelt as in the paper.

    >>> words("s_turn"), words("my_crossing")
    ('S-Turn', 'My crossing')
    """
    text = _TITLES.get(name, name.replace("_", " "))
    return text[:1].upper() + text[1:]


def styled(font_pt: float = 7.5) -> AbstractContextManager[None]:
    """Returns a context in which all figures have the same style."""
    settings: Any = {
        "font.size": font_pt,
        "axes.titlesize": font_pt + 0.5,
        "axes.labelsize": font_pt,
        **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), font_pt - 0.5),
        **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color"), _TEXT),
        **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
        **dict.fromkeys(("axes.edgecolor", "grid.color"), _FAINT),
        "axes.linewidth": 0.7,
        "grid.alpha": 0.35,
        "grid.linewidth": 0.5,
        "text.parse_math": False,  # $ is literal
    }
    return mpl.rc_context(settings)


def encoded(figure: Figure, kind: str, dpi: int = 300) -> bytes:
    """Returns a figure as "png", "pdf" or "svg"; equal figures give equal bytes."""
    data = io.BytesIO()
    undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind)
    # Type 42 keeps text as text; the salt makes an SVG's ids the same every time.
    settings: Any = {"pdf.fonttype": 42, "svg.hashsalt": "flowrep", "hatch.linewidth": 0.7}
    with mpl.rc_context(settings):
        figure.savefig(data, format=kind, dpi=dpi, metadata=undated)
    return data.getvalue()


def draw_bars(grids: Sequence[SuccessGrid]) -> Figure:
    """Returns grouped bars: a panel per scene, a group per speed mode, a bar per stack."""
    handles: list[Any] = [
        Patch(facecolor=look.colour, hatch=look.hatch, edgecolor="white", lw=0, label=name)
        for name, look in looks(grids[0].series).items()
    ]
    shown = {name for grid in grids for name, _ in grid.baselines}
    handles += [
        Line2D([], [], linestyle=line, color=_TEXT, linewidth=1.0, label=words(name).lower())
        for name, line in _BASELINE_LINES.items()
        if name in shown
    ]
    return _panels([(grid.scene, grid) for grid in grids], _bars, handles)


def draw_rates(grids: Sequence[SuccessGrid]) -> Figure:
    """Returns success over frame rates: a panel per scene, a line per stack."""
    panels = [(grid.scene, grid) for grid in grids]
    return _panels(panels, _rate_lines, _line_handles(looks(grids[0].series)))


def draw_curves(panels: Sequence[tuple[str, Mapping[str, Sequence[Curve]]]]) -> Figure:
    """Returns learning curves, a panel per scene.

    Bold lines are the mean of evaluations over seeds, thin lines each seed's training episodes.
    """
    style = looks(list(dict.fromkeys(name for _, curves in panels for name in curves)))

    def draw(axes: Axes, curves: Mapping[str, Sequence[Curve]]) -> None:
        for name, of_runs in curves.items():
            for curve in of_runs:
                thin: Any = {"color": style[name].colour, "linewidth": 0.6, "alpha": 0.6}
                axes.plot(*_thousands_and_percent(curve.training), **thin)
            mean = mean_curve([curve.evaluated for curve in of_runs])
            axes.plot(*_thousands_and_percent(mean), linewidth=1.5, **style[name].line)
        axes.set_xlabel("frames (thousands)")

    return _panels(panels, draw, _line_handles(style))


def mean_curve(curves: Sequence[Sequence[tuple[int, float]]]) -> list[tuple[int, float]]:
    """Returns the mean over curves, at the frame counts that most of them have.

    >>> mean_curve([[(10, 0.0), (20, 0.5)], [(10, 1.0), (20, 1.0)], [(10, 0.5)]])
    [(10, 0.5), (20, 0.75)]
    """
    at: dict[int, list[float]] = {}
    for frames, share in (point for curve in curves for point in curve):
        at.setdefault(frames, []).append(share)
    common = ((n, shares) for n, shares in sorted(at.items()) if 2 * len(shares) > len(curves))
    return [(frames, float(np.mean(shares))) for frames, shares in common]


def _panels(
    panels: Sequence[tuple[str, Any]], draw: Callable[[Axes, Any], None], handles: Sequence[Any]
) -> Figure:
    columns = min(len(panels), _MOST_PANELS_IN_A_ROW)
    rows = -(-len(panels) // columns)
    width = _COLUMN_IN if len(panels) == 1 else _PAGE_IN
    with styled():
        figure = Figure(figsize=(width, 2.2 * rows), layout="constrained")
        all_axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel().tolist()
        for spare in all_axes[len(panels) :]:
            spare.set_visible(False)
        for axes, (scene, data) in zip(all_axes, panels):
            draw(axes, data)
            axes.set(title=words(scene), ylim=(0, 100), yticks=range(0, 101, 25), axisbelow=True)
            axes.grid(axis="y")
        all_axes[0].set_ylabel("success (% of episodes)")
        em_in = mpl.rcParams["font.size"] / 72
        longest = max(len(handle.get_label()) for handle in handles)
        entry_in = (0.5 * longest + 3.5) * em_in  # half an em a letter, 3.5 for the sign and gaps
        beside = min(len(handles), max(1, int(width / entry_in)))
        # Matplotlib fills a legend column by column, but people read row by row.
        by_column = [handle for start in range(beside) for handle in handles[start::beside]]
        gaps = {"handlelength": 1.8, "columnspacing": 1.2, "handletextpad": 0.5}
        figure.legend(handles=by_column, loc="outside upper center", ncols=beside, **gaps)
    return figure


def _bars(axes: Axes, grid: SuccessGrid) -> None:
    width = min(0.84 / len(grid.series), _WIDEST_BAR)
    for group, condition in enumerate(grid.conditions):
        for index, (name, look) in enumerate(looks(grid.series).items()):
            at = group + (index - (len(grid.series) - 1) / 2) * width
            cell = grid.cells.get((name, condition))
            if cell is None:
                style: Any = {"rotation": 90, "ha": "center", "va": "bottom", "color": _FAINT}
                axes.text(at, 1.5, "missing", fontsize="x-small", **style)
                continue
            edge = "white" if look.hatch else _TEXT
            height, lengths = 100 * cell.score.value, _whiskers([cell.score])
            style = {"facecolor": look.colour, "hatch": look.hatch, "edgecolor": edge}
            axes.bar(at, height, 0.92 * width, linewidth=0, **style)
            axes.errorbar(at, height, lengths, color=_TEXT, linewidth=0.9, **_CAPS)
            # The seeds stand beside the whisker: on it, a dot would hide the interval's ends.
            if len(cell.rates) > 1:
                dots = (100 * cell.rates).tolist()
                ring: Any = {"facecolor": "white", "edgecolor": _TEXT, "linewidth": 0.5}
                beside = [at + 0.24 * width] * len(dots)
                axes.scatter(beside, dots, s=5, zorder=4, clip_on=False, **ring)
        for name, line in _BASELINE_LINES.items():
            share = grid.baselines.get((name, condition))
            if share is not None:
                ends = [group - 0.46, group + 0.46]
                axes.plot(ends, [100 * share] * 2, linestyle=line, color=_TEXT, linewidth=1.0)
    axes.set_xticks(range(len(grid.conditions)), [c.speed for c in grid.conditions])
    axes.set(xlim=(-0.5, len(grid.conditions) - 0.5), xlabel="pedestrians' speed mode")
    axes.tick_params(axis="x", length=0)


def _whiskers(scores: Sequence[Estimate]) -> list[list[float]]:
    below = [max(100 * (score.value - score.low), 0) for score in scores]
    return [below, [max(100 * (score.high - score.value), 0) for score in scores]]


def _rate_lines(axes: Axes, grid: SuccessGrid) -> None:
    at = [condition.fps for condition in grid.conditions]
    step = min((b - a for a, b in pairwise(at)), default=1.0)
    for index, (name, look) in enumerate(looks(grid.series).items()):
        # Side by side, so that whiskers of equal scores are all visible.
        aside = (index - (len(grid.series) - 1) / 2) * 0.08 * step
        driven = [c for c in grid.conditions if (name, c) in grid.cells]
        if driven:
            scores = [grid.cells[name, c].score for c in driven]
            xs, values = [c.fps + aside for c in driven], [100 * score.value for score in scores]
            lines: Any = {"linewidth": 1.3, "elinewidth": 0.9, **look.line, **_CAPS}
            axes.errorbar(xs, values, _whiskers(scores), **lines)
    axes.set_xticks(at, [f"{rate:g}" for rate in at])
    axes.set_xlabel("frames per second (Hz)")


def _thousands_and_percent(points: Sequence[tuple[int, float]]) -> tuple[list[float], list[float]]:
    return [frames / 1000 for frames, _ in points], [100 * share for _, share in points]


def _line_handles(style: Mapping[str, Look]) -> list[Any]:
    return [Line2D([], [], linewidth=1.3, label=name, **look.line) for name, look in style.items()]
