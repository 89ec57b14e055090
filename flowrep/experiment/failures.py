"""Causes of failure as in the paper's Table III, printed and as CSV."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from flowrep.tables import write_rows

CAUSES = ("out of bounds", "collision: pedestrian", "collision: other", "timeout")
_GROUP = ("scene", "representations", "flow", "frames", "evaluation", "policy", "speed", "fps")


def cause_of(outcome: str, hit: str) -> str | None:
    """Returns why an episode failed, None if it did not.

    >>> cause_of("collision", "car"), cause_of("success", "")
    ('collision: other', None)
    """
    if outcome == "success":
        return None
    if outcome == "collision":
        return "collision: pedestrian" if hit == "pedestrian" else "collision: other"
    return outcome.replace("_", " ")


def failure_causes(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns the number of failures and their causes in % for each scene, policy and speed.

    Shares are of the failures, as in the paper's Table III, and empty where nothing failed.
    Evaluations after different numbers of training frames are kept apart.

    Args:
        rows: rows of evaluation.csv.
    """
    groups: dict[tuple[str, ...], list[str | None]] = defaultdict(list)
    for row in rows:
        key = tuple(str(row.get(name, "")) for name in _GROUP)
        groups[key].append(cause_of(row["outcome"], row.get("hit", "")))
    table = []
    for key, causes in groups.items():
        counts = Counter(cause for cause in causes if cause is not None)
        failures = counts.total()
        shares = {c: round(100 * counts[c] / failures, 1) if failures else "" for c in CAUSES}
        line = dict(zip(_GROUP, key)) | {"episodes": len(causes), "failures": failures} | shares
        collisions = sum(counts[cause] for cause in CAUSES if cause.startswith("collision"))
        ratio = round(counts["out of bounds"] / collisions, 3) if collisions else ""
        table.append(line | {"out of bounds to collisions": ratio})
    return table


def print_failures(rows: Sequence[Mapping[str, Any]], console: Console | None = None) -> None:
    """Prints the causes of failure by policy and speed."""
    table = Table(title="Causes of failure in % of the failures", box=box.SIMPLE, pad_edge=False)
    for heading in ("speed", "fps", "policy", "failures"):
        table.add_column(heading, no_wrap=heading != "policy", overflow="fold")  # it may be a path
    lines = failure_causes(rows)
    for cause in CAUSES:
        # In two lines, so that all fit into 100 columns.
        heading = cause.replace(": ", ":\n").replace("of ", "of\n")
        table.add_column(heading, justify="right", no_wrap=True)
    for line in lines:
        shares = ["" if line[cause] == "" else f"{line[cause]:.0f}" for cause in CAUSES]
        failed = f"{line['failures']} of {line['episodes']}"
        rate = f"{float(line['fps']):g}"
        table.add_row(line["speed"], rate, line["policy"], failed, *shares)
    (console or Console(width=max(100, Console().width))).print(table)


def write_failures(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes the causes of failure as CSV, in place of an older table."""
    write_rows(path, failure_causes(rows))
