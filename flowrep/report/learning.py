"""Learning curves: greedy evaluations while agents learned, and the share of training episodes."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from flowrep.report.cells import success
from flowrep.report.figures import canvas, legend, line_handles, percent_axis, style_for
from flowrep.report.runs import Run
from flowrep.report.statistics import interquartile_mean
from flowrep.report.style import Theme, looks, words


class Curve(NamedTuple):
    """One run's (frames, share of success) in evaluations and in training episodes."""

    evaluated: list[tuple[int, float]]
    training: list[tuple[int, float]]


class CurvePanel(NamedTuple):
    """The curves of one scene's runs, by stack."""

    scene: str
    curves: dict[str, list[Curve]]


def curve_of(run: Run) -> Curve:
    """Returns greedy evaluations at the run's own speed and frame rate, and training episodes."""
    outcomes: dict[int, list[float]] = defaultdict(list)
    for row in run.episodes:
        is_own = row["evaluation"] in ("training", "final") and row["scene"] == run.scene
        as_trained = row["speed"] == run.speed and float(row["fps"]) == run.fps
        if is_own and as_trained and row["policy"] == "greedy":
            outcomes[int(row["frames"])].append(success(row))
    evaluated = [(frames, float(np.mean(found))) for frames, found in sorted(outcomes.items())]
    training = [
        (int(row["frames"]), float(row["success"])) for row in run.metrics if row.get("success")
    ]
    return Curve(evaluated, training)


def curve_panels(runs: Mapping[str, Sequence[Run]], scenes: Sequence[str]) -> list[CurvePanel]:
    """Returns the curves of each scene that has any."""
    panels = []
    for scene in scenes:
        curves = {
            name: [curve_of(run) for run in members if run.scene == scene]
            for name, members in runs.items()
        }
        if any(curve.evaluated or curve.training for of in curves.values() for curve in of):
            panels.append(CurvePanel(scene, {name: of for name, of in curves.items() if of}))
    return panels


def draw_curves(panels: Sequence[CurvePanel], theme: Theme, *, for_page: bool = False) -> Figure:
    """Draws a panel per scene: bold, the seeds' mean of evaluations; thin, each seed's training."""
    with style_for(theme, for_page=for_page):
        figure, all_axes = canvas(len(panels), theme, for_page=for_page)
        names = list(dict.fromkeys(name for panel in panels for name in panel.curves))
        style = looks(names, theme)
        for axes, panel in zip(all_axes, panels):
            for name, curves in panel.curves.items():
                look = style[name]
                for curve in curves:
                    xs, ys = _thousands(curve.training)
                    axes.plot(xs, ys, color=look.colour, linewidth=0.6, alpha=0.6)
                xs, ys = _thousands(together([curve.evaluated for curve in curves]))
                axes.plot(
                    xs, ys, color=look.colour, linestyle=look.dashes, marker=look.marker,
                    markersize=3.5, linewidth=1.5,
                )  # fmt: skip
            axes.set_title(words(panel.scene))
            axes.set_xlabel("frames (thousands)")
        percent_axis(all_axes)
        legend(figure, line_handles(names, theme))
    return figure


def together(curves: Sequence[Sequence[tuple[int, float]]]) -> list[tuple[int, float]]:
    """Returns the interquartile mean over curves, at the frames that most of them have.

    >>> together([[(10, 0.0), (20, 0.5)], [(10, 1.0), (20, 1.0)], [(10, 0.5)]])
    [(10, 0.5), (20, 0.75)]
    """
    at: dict[int, list[float]] = defaultdict(list)
    for curve in curves:
        for frames, share in curve:
            at[frames].append(share)
    return [
        (frames, float(interquartile_mean(shares)))
        for frames, shares in sorted(at.items())
        if 2 * len(shares) > len(curves)
    ]


def _thousands(points: Sequence[tuple[int, float]]) -> tuple[list[float], list[float]]:
    return [frames / 1000 for frames, _ in points], [100 * share for _, share in points]
