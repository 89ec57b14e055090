"""The parts of a report: headings, notes, figures and tables, independent of the medium."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from flowrep.report.results import Grid
from flowrep.report.runs import Condition
from flowrep.report.statistics import Estimate
from flowrep.report.style import LIGHT, Theme, words
from flowrep.report.tables import Table, latex_text

MISSING = "missing"


@dataclass(frozen=True)
class Drawing:
    """A figure that can be drawn whole for a paper, or panel by panel for a page.

    Args:
        name: the name of its files.
        caption: describes the figure and its intervals.
        panels: the data of each panel.
        draw: draws panels side by side.
    """

    name: str
    caption: str
    panels: tuple[Any, ...]
    draw: Callable[..., Figure]

    def whole(self) -> Figure:
        """Returns the figure for a paper."""
        return self.draw(self.panels, LIGHT)

    def parts(self, theme: Theme) -> list[Figure]:
        """Returns one figure per panel, for a page."""
        return [self.draw([panel], theme, for_page=True) for panel in self.panels]

    def to_latex(self) -> str:
        """Returns a figure environment around the PDF, which lies beside it."""
        kind, width = ("figure*", r"\textwidth") if len(self.panels) > 1 else (
            "figure", r"\columnwidth"
        )  # fmt: skip
        return "\n".join(
            [
                rf"\begin{{{kind}}}[t]",
                r"  \centering",
                rf"  \includegraphics[width={width}]{{{self.name}.pdf}}",
                rf"  \caption{{{latex_text(self.caption)}}}",
                rf"  \label{{fig:{self.name}}}",
                rf"\end{{{kind}}}",
                "",
            ]
        )


@dataclass(frozen=True)
class Section:
    """One part of a report.

    Args:
        name: the name of the folder of its files.
        title: its heading.
        notes: sentences before its figures on what is missing or left out.
        drawings: its figures.
        tables: its tables.
    """

    name: str
    title: str
    notes: tuple[str, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    tables: tuple[Table, ...] = ()


def percent(estimate: Estimate) -> str:
    """Returns a share with its interval in %.

    >>> percent(Estimate(0.854, 0.791, 0.901))
    '85 [79–90]'
    """
    value, low, high = (f"{100 * number:.0f}" for number in estimate)
    return f"{value} [{low}–{high}]"


def points(estimate: Estimate) -> str:
    """Returns a difference of shares with its interval in percentage points.

    >>> points(Estimate(0.123, -0.031, 0.2))
    '+12 [−3, +20]'
    """
    value, low, high = (_signed(100 * number) for number in estimate)
    return f"{value} [{low}, {high}]"


def _signed(number: float) -> str:
    whole = round(number)
    return f"{'+' if whole > 0 else '−' if whole < 0 else ''}{abs(whole)}"


def listed(names: Sequence[str]) -> str:
    """Returns names as a list in a sentence.

    >>> listed(["a", "b", "c"]), listed(["a"])
    ('a, b and c', 'a')
    """
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def what_is_missing(grids: Sequence[Grid]) -> tuple[str, ...]:
    """Returns a sentence per scene on the cells that no finished run fills."""
    notes = []
    for grid in grids:
        empty: dict[str, list[Condition]] = {}
        for name in grid.series:
            lacking = [c for c in grid.conditions if grid.scores[name, c] is None]
            if lacking:
                empty[name] = lacking
        if empty:
            parts = [
                name if len(lacking) == len(grid.conditions) else f"{name} ({_conditions(lacking)})"
                for name, lacking in empty.items()
            ]
            notes.append(f"Missing in {words(grid.scene)}: {listed(parts)}.")
    return tuple(notes)


def _conditions(conditions: Sequence[Condition]) -> str:
    rates = {c.fps for c in conditions}
    speeds = {c.speed for c in conditions}
    if len(speeds) > 1 or len(rates) == 1:
        return listed([c.speed for c in conditions])
    return listed([f"{c.fps:g}" for c in conditions]) + " Hz"
