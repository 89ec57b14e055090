"""Reports on runs: `python -m flowrep.report outputs/<sweep>`.

Slow imports wait until the config has been checked and the runs have been read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from flowrep.extras import require

require("a report", "report", "hydra", "pydantic", "matplotlib", "scipy", "jinja2", module=__name__)

from pydantic import Field

from flowrep.config.cli import run_command
from flowrep.config.options import Command, OneOrMore, Text
from flowrep.config.usage import UsageError
from flowrep.files import refuse_link, replace_text


class ReportConfig(Command):
    """The whole config of `flowrep.report`."""

    run: Annotated[list[Text], Field(min_length=1), OneOrMore]
    output: Text | None
    policy: Literal["greedy", "sampled"]


def report(config: ReportConfig) -> Path:
    """Writes figures, tables and a page of runs; returns the page's path."""
    from flowrep.experiment.outcomes import print_table
    from flowrep.report.runs import read_runs, without_repeats

    folders = list(map(Path, config.run))
    output = Path(config.output) if config.output else refuse_link(folders[0] / "report")
    readable, unreadable = read_runs(folders)
    runs, repeats = without_repeats(readable)
    warnings = [*unreadable, *repeats]
    for warning in warnings:
        print(f"left out: {warning}")
    if not runs:
        raise UsageError("none of the runs can be read, see above")

    from flowrep.report.page import render_page, summary
    from flowrep.report.sections import assemble, write_files

    print(summary(runs))
    assembled = assemble(runs, warnings, config.policy)
    for warning in assembled.warnings[len(warnings) :]:
        print(f"used in part: {warning}")
    for section in assembled.sections:
        for table in section.tables:
            if not table.name.endswith("_differences"):  # these are too long for a screen
                for block, rows in table.blocks:
                    title = " ".join(filter(None, (section.title, section.label, block)))
                    print_table(title, [dict(zip(table.header, row)) for row in rows], 160)
    output.mkdir(parents=True, exist_ok=True)
    for folder in write_files(assembled, output):
        print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
    page = output / "index.html"
    replace_text(page, render_page(assembled))
    print(f"page: {page}")
    return page


def main() -> None:
    """Entry point; a mistake on the command line ends in one line that names the remedy."""
    run_command("report", report, ReportConfig)


if __name__ == "__main__":
    main()
