"""Writes the files of a report: a folder per section, and the page."""

from collections.abc import Collection, Iterator
from hashlib import sha256
from pathlib import Path

from matplotlib.figure import Figure

from flowrep.report.assembly import Report
from flowrep.report.sections import Section
from flowrep.report.style import LIGHT, saving

_DPI = 300
PAGE = "index.html"
LIST = ".report_files"
"""The list of the files that a report wrote into its folder, with their checksums."""


def write_files(report: Report, folder: Path) -> list[Path]:
    """Writes each section's figures and tables as PNG, PDF, LaTeX and CSV; returns their folders.

    The same report gives the same files, byte for byte. Files of an earlier report in this folder
    that this one doesn't have are removed, unless they were changed since.
    """
    folder.mkdir(parents=True, exist_ok=True)
    sections = [section for chapter in report.chapters for section in chapter.sections]
    names = []
    # line by line, so that an interrupted report has a list, too
    with (folder / LIST).open("a", encoding="utf-8", buffering=1) as lines:
        for section in sections:
            for path in _write(section, folder / section.name):
                names.append(path.relative_to(folder).as_posix())
                lines.write(_line(folder, names[-1]))
    _remove_others(folder, names)
    (folder / LIST).write_text("".join(_line(folder, name) for name in names), encoding="utf-8")
    return [folder / section.name for section in sections]


def _write(section: Section, place: Path) -> Iterator[Path]:
    """Writes a section's files, yielding the path of each."""
    place.mkdir(exist_ok=True)
    for drawing in section.drawings:
        yield from save(drawing.whole(), place / drawing.name)
        yield _written(place / f"{drawing.name}.tex", drawing.to_latex())
    for table in section.tables:
        yield from save(table.draw(LIGHT), place / table.name)
        yield _written(place / f"{table.name}.tex", table.to_latex())
        yield _written(place / f"{table.name}.csv", table.to_csv())


def _written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def _line(folder: Path, name: str) -> str:
    return f"{sha256((folder / name).read_bytes()).hexdigest()} {name}\n"


def _remove_others(folder: Path, kept: Collection[str]) -> None:
    """Removes the listed files that are as they were written, and folders that are then empty."""
    text = (folder / LIST).read_text(encoding="utf-8", errors="replace")
    for line in text.splitlines(keepends=True):
        name = line.rstrip("\n").partition(" ")[2]
        path = folder / name
        is_inside = path.resolve().is_relative_to(folder.resolve())
        if name in kept or not is_inside or not path.is_file() or _line(folder, name) != line:
            continue
        path.unlink()
        if not any(path.parent.iterdir()):
            path.parent.rmdir()


def write_page(text: str, folder: Path) -> Path:
    """Writes the page into the report's folder; returns its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / PAGE
    whole = path.with_suffix(".tmp")
    whole.write_text(text, encoding="utf-8")
    whole.replace(path)
    return path


def save(figure: Figure, path: Path) -> tuple[Path, Path]:
    """Writes a figure as PNG and PDF, whose paths it returns; the endings are added to the path."""
    png, pdf = (path.with_name(f"{path.name}.{ending}") for ending in ("png", "pdf"))
    with saving():
        figure.savefig(png, dpi=_DPI)
        figure.savefig(pdf, metadata={"CreationDate": None})
    return png, pdf
