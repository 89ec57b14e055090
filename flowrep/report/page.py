"""One self-contained HTML page: pictures, films and styles are embedded."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from flowrep.report.assembly import Chapter, Report
from flowrep.report.drives import Drives
from flowrep.report.pictures import svg_uri
from flowrep.report.runs import Run
from flowrep.report.sections import Drawing, Section, listed
from flowrep.report.style import DARK, LIGHT, words


def render_page(report: Report, drives: Drives, sources: Sequence[Path]) -> str:
    """Returns the page.

    Args:
        report: the report on the runs.
        drives: plans and films of some of their episodes, possibly none.
        sources: the folders that were read, for the heading.
    """
    folder = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    chapters = [_chapter(number, chapter) for number, chapter in enumerate(report.chapters)]
    return environment.get_template("page.html.jinja").render(
        title=listed([str(source) for source in sources]),
        summary=summary(report.runs),
        complaints=report.complaints,
        chapters=chapters,
        drives=drives,
        runs=[_row(run) for run in report.runs],
    )


def summary(runs: Sequence[Run]) -> str:
    """Returns a sentence on the runs that were read."""
    finished = sum(run.is_finished for run in runs)
    stacks = sorted({run.stack for run in runs})
    scenes = [words(scene) for scene in dict.fromkeys(run.scene for run in runs)]
    episodes = sum(len(run.tested) for run in runs)
    return (
        f"{_count(len(runs), 'run')}, {finished} of them finished, of "
        f"{_count(len(stacks), 'stack')} ({listed(stacks)}) in {listed(scenes)}; {episodes:,} "
        "evaluated episodes, those of baselines included."
    )


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _chapter(number: int, chapter: Chapter) -> dict[str, Any]:
    return {
        "label": chapter.label,
        "sections": [_section(f"{number}-{section.name}", section) for section in chapter.sections],
    }


def _section(anchor: str, section: Section) -> dict[str, Any]:
    return {
        "anchor": anchor,
        "title": section.title,
        "notes": section.notes,
        "drawings": [_drawing(drawing) for drawing in section.drawings],
        "tables": section.tables,
    }


def _drawing(drawing: Drawing) -> dict[str, Any]:
    themes = zip(drawing.parts(LIGHT), drawing.parts(DARK))
    return {
        "caption": drawing.caption,
        "panels": [{"light": svg_uri(light), "dark": svg_uri(dark)} for light, dark in themes],
    }


def _row(run: Run) -> dict[str, Any]:
    return {
        "path": str(run.path),
        "experiment": run.config.get("experiment") or "",
        "scene": words(run.scene),
        "stack": run.stack,
        "seed": run.seed,
        "frames": f"{run.frames:,} of {run.total_frames:,}",
        "episodes": f"{len(run.tested):,}",
    }
