"""Writes the files of a report: a folder per section, and the page."""

from pathlib import Path

from matplotlib.figure import Figure

from flowrep.report.assembly import Report
from flowrep.report.style import LIGHT, saving

_DPI = 300
PAGE = "index.html"


def write_files(report: Report, folder: Path) -> list[Path]:
    """Writes each section's figures and tables as PNG, PDF, LaTeX and CSV; returns their folders.

    The same report gives the same files, byte for byte.
    """
    written = []
    for chapter in report.chapters:
        for section in chapter.sections:
            place = folder / section.name
            place.mkdir(parents=True, exist_ok=True)
            written.append(place)
            for drawing in section.drawings:
                save(drawing.whole(), place / drawing.name)
                (place / f"{drawing.name}.tex").write_text(drawing.to_latex(), encoding="utf-8")
            for table in section.tables:
                save(table.draw(LIGHT), place / table.name)
                (place / f"{table.name}.tex").write_text(table.to_latex(), encoding="utf-8")
                (place / f"{table.name}.csv").write_text(table.to_csv(), encoding="utf-8")
    return written


def write_page(text: str, folder: Path) -> Path:
    """Writes the page into the report's folder; returns its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / PAGE
    whole = path.with_suffix(".tmp")
    whole.write_text(text, encoding="utf-8")
    whole.replace(path)
    return path


def save(figure: Figure, path: Path) -> None:
    """Writes a figure as PNG and PDF; the endings are added to the path."""
    with saving():
        figure.savefig(path.with_name(f"{path.name}.png"), dpi=_DPI)
        figure.savefig(path.with_name(f"{path.name}.pdf"), metadata={"CreationDate": None})
