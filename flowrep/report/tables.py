"""Tables of a report, as LaTeX (booktabs) and CSV, and numbers as text."""

import csv
import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flowrep.report.statistics import Estimate

MISSING = "missing"
_LATEX: dict[str, str] = {character: rf"\{character}" for character in "&%$#_{}"} | {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "–": "--", "−": "$-$", "×": r"$\times$", "→": r"$\to$", "∞": r"$\infty$", "≥": r"$\ge$",
    "<": "$<$", ">": "$>$",
}  # fmt: skip


class Table(NamedTuple):
    """Text in rows.

    Args:
        name: the name of its files.
        caption: describes the numbers.
        header: the columns' names; the first column is aligned left, the others right.
        blocks: (heading, rows) of groups of rows; a heading may be empty.
        words: indices of further columns that are aligned left.
    """

    name: str
    caption: str
    header: tuple[str, ...]
    blocks: tuple[tuple[str, tuple[tuple[str, ...], ...]], ...]
    words: tuple[int, ...] = ()

    @property
    def alignment(self) -> str:
        """A letter for each column, "l" or "r"."""
        return "".join("l" if i in (0, *self.words) else "r" for i in range(len(self.header)))

    def to_latex(self) -> str:
        """Returns a table environment for booktabs."""
        lines = [_latex_row(self.header)]
        for heading, rows in self.blocks:
            lines.append(r"\midrule")
            if heading:
                span = rf"\multicolumn{{{len(self.header)}}}{{l}}"
                lines.append(rf"{span}{{\textit{{{latex_text(heading)}}}}} \\")
            lines += map(_latex_row, rows)
        body = "\n    ".join(lines)
        return rf"""\begin{{table}}[t]
  \centering
  \caption{{{latex_text(self.caption)}}}
  \label{{tab:{self.name}}}
  \begin{{tabular}}{{{self.alignment}}}
    \toprule
    {body}
    \bottomrule
  \end{{tabular}}
\end{{table}}
"""

    def to_csv(self) -> str:
        """Returns a CSV table; a block's heading is its rows' first cell."""
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        has_blocks = any(heading for heading, _ in self.blocks)
        writer.writerow([*(["group"] if has_blocks else []), *self.header])
        for heading, rows in self.blocks:
            writer.writerows([*([heading] if has_blocks else []), *row] for row in rows)
        return text.getvalue()


def latex_text(text: str) -> str:
    r"""Returns text with LaTeX's special characters escaped.

    >>> print(latex_text("85 % of ego_x"))
    85 \% of ego\_x
    """
    return "".join(_LATEX.get(character, character) for character in text)


def _latex_row(row: Sequence[str]) -> str:
    return " & ".join(latex_text(cell) for cell in row) + r" \\"


def percent(estimate: Estimate, digits: int = 0) -> str:
    """Returns a share with its interval in %.

    >>> percent(Estimate(0.854, 0.791, 0.901))
    '85 [79–90]'
    """
    value, low, high = (100 * number for number in estimate)
    return f"{value:.{digits}f} [{low:.0f}–{high:.0f}]"


def points(estimate: Estimate) -> str:
    """Returns a difference of shares with its interval in percentage points.

    >>> points(Estimate(0.123, -0.031, 0.2))
    '+12 [−3, +20]'
    """
    value, low, high = (signed(number) for number in estimate)
    return f"{value} [{low}, {high}]"


def ratio(share: Estimate) -> str:
    """Returns share : rest with its interval.

    >>> ratio(Estimate(0.2, 0.1, 0.5))
    '0.250 [0.111–1.000]'
    """
    value, low, high = (f"{number / (1 - number):.3f}" if number < 1 else "∞" for number in share)
    return f"{value} [{low}–{high}]"


def signed(share: float) -> str:
    """Returns a difference in points with its sign, as text."""
    whole = round(100 * share)
    return f"{'+' if whole > 0 else '−' if whole < 0 else ''}{abs(whole)}"


def p_text(p_value: float) -> str:
    """Returns a p value as text, nothing for one that isn't known.

    >>> p_text(0.0449), p_text(0.0001), p_text(float("nan"))
    ('0.045', '<0.001', '')
    """
    if np.isnan(p_value):
        return ""
    return "<0.001" if p_value < 0.0005 else f"{p_value:.3f}"


def listed(names: Sequence[str]) -> str:
    """Returns names as a list in a sentence.

    >>> listed(["a", "b", "c"]), listed(["a"])
    ('a, b and c', 'a')
    """
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
