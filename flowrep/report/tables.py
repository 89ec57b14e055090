"""Tables of a report, and numbers as text."""

import csv
import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flowrep.report.statistics import Estimate

MISSING = "missing"


class Table(NamedTuple):
    """A table of texts; its rows are grouped in blocks."""

    name: str  # of its files
    caption: str
    header: tuple[str, ...]
    blocks: tuple[tuple[str, tuple[tuple[str, ...], ...]], ...]  # headings, "" for none, and rows
    words: tuple[int, ...] = ()  # columns that are aligned left, apart from the first

    @property
    def alignment(self) -> str:
        """A letter for each column, "l" or "r"."""
        return "".join("l" if i in (0, *self.words) else "r" for i in range(len(self.header)))

    def to_csv(self) -> str:
        """Returns a CSV table; a block's heading is its rows' first cell."""
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        first = 0 if any(heading for heading, _ in self.blocks) else 1
        for heading, rows in (("group", (self.header,)), *self.blocks):
            writer.writerows((heading, *row)[first:] for row in rows)
        return text.getvalue()


def percent(estimate: Estimate, digits: int = 0) -> str:
    """Returns a share and its interval, if known, in %: "85 [79–90]"."""
    value, low, high = (100 * number for number in estimate)
    interval = "" if np.isnan(low) else f" [{low:.0f}–{high:.0f}]"
    return f"{value:.{digits}f}{interval}"


def points(estimate: Estimate) -> str:
    """Returns a difference and its interval, if known, in points: "+12 [−3, +20]".

    Shares differ by 100 points at most; an interval of ±100 or more, as that of two runs may be,
    says nothing.
    """
    value, low, high = estimate
    if high - low >= 2:
        return f"{signed(value)} [too few runs]"
    interval = "" if np.isnan(low) else f" [{signed(max(low, -1))}, {signed(min(high, 1))}]"
    return signed(value) + interval


def ratio(share: Estimate) -> str:
    """Returns share / (1 - share) and its interval: "0.250 [0.111–1.000]"."""
    value, low, high = (f"{number / (1 - number):.3f}" if number < 1 else "∞" for number in share)
    return f"{value} [{low}–{high}]"


def signed(share: float) -> str:
    """Returns a difference in points with its sign: "+12"."""
    whole = round(100 * share)
    return f"{'+' if whole > 0 else '−' if whole < 0 else ''}{abs(whole)}"


def p_text(p_value: float) -> str:
    """Returns a p value as text, "" if it is unknown."""
    if np.isnan(p_value):
        return ""
    return "<0.001" if p_value < 0.0005 else f"{p_value:.3f}"


def listed(names: Sequence[str]) -> str:
    """Returns names as a list in a sentence: "a, b and c"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
