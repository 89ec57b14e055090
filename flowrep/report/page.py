"""One self-contained HTML page, and the files of a report's figures and tables."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from flowrep.report.drives import Drives
from flowrep.report.figures import data_uri, save, svg, words
from flowrep.report.runs import Run, scenes_of
from flowrep.report.sections import Report, Section
from flowrep.report.tables import listed

PAGE = "index.html"


def write_files(report: Report, folder: Path) -> list[Path]:
    """Writes each section's figures and tables as PNG, PDF, LaTeX and CSV; returns their folders.

    The same report gives the same files, byte for byte.
    """
    sections = [section for chapter in report.chapters for section in chapter.sections]
    for section in sections:
        place = folder / section.name
        place.mkdir(parents=True, exist_ok=True)
        for drawing in section.drawings:
            save(drawing.draw(drawing.panels), place / drawing.name)
            (place / f"{drawing.name}.tex").write_text(drawing.to_latex(), encoding="utf-8")
        for table in section.tables:
            (place / f"{table.name}.tex").write_text(table.to_latex(), encoding="utf-8")
            (place / f"{table.name}.csv").write_text(table.to_csv(), encoding="utf-8")
    return [folder / section.name for section in sections]


def write_page(text: str, folder: Path) -> Path:
    """Writes the page into the report's folder; returns its path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / PAGE).write_text(text, encoding="utf-8")
    return folder / PAGE


def template(name: str, *, autoescape: bool) -> Any:
    """Returns a template of this folder."""
    loader = FileSystemLoader(Path(__file__).parent)
    return Environment(
        loader=loader, autoescape=autoescape, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    ).get_template(name)  # fmt: skip


def render_page(report: Report, drives: Drives) -> str:
    """Returns the page of a report.

    Args:
        report: the report on the runs.
        drives: plans and films of some of their episodes, possibly none.
    """
    chapters = [
        {
            "label": chapter.label,
            "sections": [_section(f"{n}-{s.name}", s) for s in chapter.sections],
        }
        for n, chapter in enumerate(report.chapters)
    ]
    return template("page.html.jinja", autoescape=True).render(
        title=title(report.runs),
        summary=summary(report.runs),
        warnings=report.warnings,
        chapters=chapters,
        drives=drives,
        runs=[_row(run) for run in report.runs],
    )


def title(runs: Sequence[Run]) -> str:
    """Returns what runs are about: their stacks if they are few, and their scenes."""
    stacks = sorted({run.stack for run in runs})
    what = listed(stacks) if len(stacks) < 4 else f"{len(stacks)} stacks"
    return f"{what} in {listed([words(scene) for scene in scenes_of(runs)])}" if runs else "No runs"


def summary(runs: Sequence[Run]) -> str:
    """Returns a sentence on the runs that were read."""
    finished = sum(run.is_finished for run in runs)
    stacks = sorted({run.stack for run in runs})
    scenes = [words(scene) for scene in scenes_of(runs)]
    episodes = sum(int(run.tested.sum()) for run in runs)
    return (
        f"{_count(len(runs), 'run')}, {finished} of them finished, of "
        f"{_count(len(stacks), 'stack')} ({listed(stacks)}) in {listed(scenes)}; {episodes:,} "
        "evaluated episodes, those of baselines included."
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _section(anchor: str, section: Section) -> dict[str, Any]:
    drawings = [
        {"caption": d.caption, "panels": [data_uri("image/svg+xml", svg(f)) for f in d.parts()]}
        for d in section.drawings
    ]
    return {"anchor": anchor, "section": section, "drawings": drawings}


def _row(run: Run) -> tuple[str, ...]:
    return (
        run.name,
        run.config.get("experiment") or "",
        words(run.scene),
        run.stack,
        str(run.seed),
        f"{run.frames:,} of {run.total_frames:,}",
        f"{int(run.tested.sum()):,}",
    )
