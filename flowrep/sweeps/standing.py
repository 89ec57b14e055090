"""The state of a sweep, read from the folders of its runs."""

import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from flowrep.sweeps.ending import Ending

WAITING, RUNNING = "waiting", "running"


class Standing(NamedTuple):
    """The state of one run.

    Args:
        name: the name of its folder.
        state: "waiting", "running", or how it ended.
        frames: training frames so far, of `total`; 0 of 0 while unknown.
        success: the share of its last training episodes that succeed, or of the final greedy ones
            if it has finished; None while unknown.
        message: the error of a failed run.
    """

    name: str
    state: str
    frames: int = 0
    total: int = 0
    success: float | None = None
    message: str = ""


def standing_of(run: Path) -> Standing:
    """Returns the state of the run in a folder, which may not exist yet."""
    ending = Ending.read(run)
    if ending is not None:
        return Standing(run.name, ending.how, 0, 0, ending.success, ending.message)
    if not _is_held(run):
        return Standing(run.name, WAITING)
    row = _last_row(run / "metrics.csv")
    try:
        frames, success = int(row.get("frames") or 0), float(row.get("success") or "nan")
    except ValueError:  # another program changed the table; the run itself says so
        frames, success = 0, float("nan")
    known = None if success != success else success
    return Standing(run.name, RUNNING, frames, _total_frames(run), known)


def standings_of(runs: Sequence[Path]) -> list[Standing]:
    """Returns the states of runs, in their order."""
    return [standing_of(run) for run in runs]


def _is_held(run: Path) -> bool:
    """Returns whether a process works in a run's folder, judged by its lock file."""
    try:
        holder = json.loads((run / ".lock").read_text(encoding="utf-8"))
        if holder["host"] != platform.node():
            return True
        os.kill(holder["pid"], 0)
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return True


def _last_row(table: Path) -> dict[str, str]:
    """Returns the last complete row of a table by its columns, empty if there is none."""
    try:
        with table.open("rb") as file:
            names = file.readline().decode(errors="replace").strip().split(",")
            file.seek(max(file.tell(), table.stat().st_size - 4096))
            lines = file.read().decode(errors="replace").split("\n")[:-1]
    except OSError:
        return {}
    cells = lines[-1].strip().split(",") if lines else []
    return dict(zip(names, cells)) if len(cells) == len(names) else {}


def _total_frames(run: Path) -> int:
    try:
        text = (run / "config.yaml").read_text(encoding="utf-8", errors="replace")
        lines = [line for line in text.splitlines() if line.startswith("total_frames:")]
        return int(lines[0].partition(":")[2]) if lines else 0
    except (OSError, ValueError):
        return 0
