"""Cells of tables: estimates and names as text."""

from collections.abc import Sequence

import numpy as np

from flowrep.report.statistics import Estimate

MISSING = "missing"


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
