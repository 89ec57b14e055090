"""Tables of a report, as LaTeX (booktabs), CSV and pictures."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flowrep.report.style import Theme, styled

_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "–": "--",
    "−": "$-$",
    "×": r"$\times$",
    "→": r"$\to$",
    "∞": r"$\infty$",
    "≥": r"$\ge$",
    "<": r"$<$",
    ">": r"$>$",
}
_ROW_IN, _CHARACTER_IN, _GAP_IN = 0.19, 0.062, 0.18
_FONT_PT = 7.5


@dataclass(frozen=True)
class Table:
    """Text in rows.

    Args:
        name: the name of its files.
        caption: describes the numbers; shown with the table everywhere.
        header: the columns' names; the first column is aligned left, the others right.
        blocks: (heading, rows) of one or several groups of rows; a heading may be empty.
        words: indices of further text columns, aligned left as well.
    """

    name: str
    caption: str
    header: tuple[str, ...]
    blocks: tuple[tuple[str, tuple[tuple[str, ...], ...]], ...]
    words: tuple[int, ...] = ()

    def is_text(self, column: int) -> bool:
        """Returns whether a column is aligned left."""
        return column == 0 or column in self.words

    def to_latex(self) -> str:
        """Returns a table environment for booktabs."""
        columns = "".join("l" if self.is_text(i) else "r" for i in range(len(self.header)))
        lines = [
            r"\begin{table}[t]",
            r"  \centering",
            rf"  \caption{{{latex_text(self.caption)}}}",
            rf"  \label{{tab:{self.name}}}",
            rf"  \begin{{tabular}}{{{columns}}}",
            r"    \toprule",
            f"    {_latex_row(self.header)}",
        ]
        for heading, rows in self.blocks:
            lines.append(r"    \midrule")
            if heading:
                span = (
                    rf"\multicolumn{{{len(self.header)}}}{{l}}{{\textit{{{latex_text(heading)}}}}}"
                )
                lines.append(rf"    {span} \\")
            lines += [f"    {_latex_row(row)}" for row in rows]
        lines += [r"    \bottomrule", r"  \end{tabular}", r"\end{table}"]
        return "\n".join(lines) + "\n"

    def to_csv(self) -> str:
        """Returns a CSV table; a block's heading is its rows' first cell."""
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        has_blocks = any(heading for heading, _ in self.blocks)
        writer.writerow([*(["group"] if has_blocks else []), *self.header])
        for heading, rows in self.blocks:
            writer.writerows([*([heading] if has_blocks else []), *row] for row in rows)
        return text.getvalue()

    def draw(self, theme: Theme) -> Figure:
        """Returns the table as a figure that fits its text."""
        rows = [row for _, members in self.blocks for row in (self.header, *members)]
        widths = [
            max(len(row[i]) for row in rows) * _CHARACTER_IN + _GAP_IN
            for i in range(len(self.header))
        ]
        headings = sum(bool(heading) for heading, _ in self.blocks)
        height = (1 + headings + sum(len(members) for _, members in self.blocks)) * _ROW_IN
        height += 0.1 * (len(self.blocks) + 2)
        with styled(theme, _FONT_PT):
            figure = Figure(figsize=(sum(widths), height))
            axes = figure.add_axes((0, 0, 1, 1), xlim=(0, sum(widths)), ylim=(height, 0))
            axes.set_axis_off()
            _Pen(axes, self, widths, theme).draw()
        return figure


class _Pen:
    """Writes a table's rows downwards on axes whose units are inches."""

    def __init__(self, axes: Axes, table: Table, widths: Sequence[float], theme: Theme) -> None:
        self.axes, self.table, self.widths, self.theme = axes, table, widths, theme
        self.y = 0.05

    def draw(self) -> None:
        self._rule(1.0)
        self._row(self.table.header, weight="bold")
        for heading, rows in self.table.blocks:
            self._rule(0.5)
            if heading:
                self._text(heading, _GAP_IN / 2, "left", style="italic")
                self.y += _ROW_IN
            for row in rows:
                self._row(row)
        self._rule(1.0)

    def _rule(self, width: float) -> None:
        self.y += 0.05
        self.axes.plot([0, sum(self.widths)], [self.y] * 2, color=self.theme.text, linewidth=width)
        self.y += 0.05 if width < 1 else 0.02

    def _row(self, row: Sequence[str], **style: Any) -> None:
        left = 0.0
        for i, (text, width) in enumerate(zip(row, self.widths)):
            is_text = self.table.is_text(i)
            at = left + _GAP_IN / 2 if is_text else left + width - _GAP_IN / 2
            self._text(text, at, "left" if is_text else "right", **style)
            left += width
        self.y += _ROW_IN

    def _text(self, text: str, x: float, align: str, **style: Any) -> None:
        self.axes.text(x, self.y + _ROW_IN / 2, text, ha=align, va="center", **style)


def latex_text(text: str) -> str:
    r"""Returns text with LaTeX's special characters escaped.

    >>> print(latex_text("85 % of ego_x"))
    85 \% of ego\_x
    """
    return "".join(_LATEX.get(character, character) for character in text)


def _latex_row(row: Sequence[str]) -> str:
    return " & ".join(latex_text(cell) for cell in row) + r" \\"
