"""Reports on runs: `python -m flowrep.report outputs/<sweep>`.

Slow imports wait until the config has been checked and the runs have been read.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from flowrep.extras import require

require("a report", "report", "hydra", "pydantic", "matplotlib", "scipy", "jinja2", module=__name__)

from flowrep.config import UsageError
from flowrep.config.cli import run_command
from flowrep.config.schema import ReportConfig

if TYPE_CHECKING:
    from flowrep.report.tables import Table


def report(config: ReportConfig) -> Path:
    """Writes figures, tables and a page of runs; returns the page's path."""
    from flowrep.report.storage import is_archive, read_runs, without_repeats

    folders = list(map(Path, config.run))
    holds_runs = folders[0].is_dir() and not is_archive(folders[0])
    output = Path(config.output or (folders[0] if holds_runs else Path("outputs")) / "report")
    readable, unreadable = read_runs(folders)
    runs, repeats = without_repeats(readable)
    warnings = [*unreadable, *repeats]
    for warning in warnings:
        print(f"left out: {warning}")
    if not runs:
        raise UsageError("none of the runs can be read, see above")

    from flowrep.report.page import drives_of, render_page, summary
    from flowrep.report.sections import assemble, write_files

    print(summary(runs))
    assembled = assemble(runs, warnings, config.policy)
    for warning in assembled.warnings[len(warnings) :]:
        print(f"used in part: {warning}")
    for section in assembled.sections:
        for table in section.tables:
            if not table.name.endswith("_differences"):  # these are too long for a screen
                show(table, f"{section.title} {section.label}".strip())
    output.mkdir(parents=True, exist_ok=True)
    for folder in write_files(assembled, output):
        print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
    drives = drives_of(runs, trajectories=config.trajectories, videos=config.videos)
    for warning in drives.warnings:
        print(f"drives: {warning}")
    page = output / "index.html"
    page.write_text(render_page(assembled, drives), encoding="utf-8")
    print(f"page: {page}")
    return page


def show(table: Table, title: str) -> None:
    """Prints a table."""
    import rich.box
    import rich.table
    from rich.console import Console
    from rich.text import Text

    heading = Text(title, style="table.title")  # rich reads brackets in a str as markup
    shown = rich.table.Table(title=heading, box=rich.box.SIMPLE, pad_edge=False)
    for name, side in zip(table.header, table.alignment):
        shown.add_column(Text(name), justify="left" if side == "l" else "right", no_wrap=True)
    for block, rows in table.blocks:
        if block:
            shown.add_row(Text(block, style="italic"))
        for row in rows:
            shown.add_row(*map(Text, row))
        shown.add_section()
    Console(width=max(160, Console().width)).print(shown)


def main() -> None:
    """Entry point; a mistake on the command line ends in one line that names the remedy."""
    run_command("report", report, ReportConfig)


if __name__ == "__main__":
    main()
