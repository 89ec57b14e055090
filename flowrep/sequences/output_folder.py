"""The output folder of a job: has a temporary name until complete, and can be continued."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flowrep.experiment.tables import append_rows, is_whole, read_rows, write_rows
from flowrep.sequences.frame import SequenceError
from flowrep.sequences.scores import COLUMNS

TABLE, JOB, SUMMARY = "frames.csv", "job.json", "summary.json"


class OutputFolder:
    """`<output>.partial` while the job runs, `<output>` once it is complete.

    `job.json` holds the job's settings, `frames.csv` a row for each frame whose files are complete;
    a continued job starts after the last of them.

    Args:
        path: the final folder.
        settings: the job's settings; a job can only be continued with the same ones.
        resume: whether an unfinished job is continued.

    Raises:
        SequenceError: the folder exists already, or holds a job that can't be continued.
    """

    def __init__(self, path: str | Path, settings: Mapping[str, Any], *, resume: bool) -> None:
        self.path = Path(path)
        if self.path.exists():  # also . and /, which have no name
            raise SequenceError(self.path, "exists already; remove it, or give another output")
        self.partial = self.path.with_name(f"{self.path.name}.partial")
        if self.partial.exists() and not resume:
            raise SequenceError(
                self.partial, "is an unfinished job: resume=true continues it, or remove it"
            )
        if resume and not self.partial.exists():
            raise SequenceError(self.partial, "is not there: no unfinished job to continue")
        self._is_new = not resume
        if resume:
            self._check_settings(settings)
        else:
            self.partial.mkdir(parents=True)
            write_json(self.partial / JOB, settings)

    @property
    def table(self) -> Path:
        """The table of frames."""
        return self.partial / TABLE

    def last_index(self) -> int | None:
        """Returns the index of the last frame whose files are complete."""
        try:
            rows = read_rows(self.table)
            return int(rows[-1]["index"]) if rows else None
        except (ValueError, KeyError, TypeError):
            raise SequenceError(self.table, "is not a table of frames: remove the job") from None

    def keep_rows(self, count: int) -> None:
        """Keeps the first `count` rows, and drops an incomplete line at the end."""
        rows = read_rows(self.table)
        if len(rows) > count or not is_whole(self.table):
            write_rows(self.table, rows[:count], COLUMNS)

    def rows(self) -> list[dict[str, str]]:
        """Returns the rows so far."""
        return read_rows(self.table)

    def log(self, row: Mapping[str, Any]) -> None:
        """Appends the row of a frame whose files are complete."""
        append_rows(self.table, [row], COLUMNS)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Writes the summary and gives the folder its final name."""
        write_json(self.partial / SUMMARY, summary)
        self.partial.replace(self.path)

    def discard_if_empty(self) -> None:
        """Removes the folder if it is new and holds no complete frame."""
        if self._is_new and not self.table.exists():
            shutil.rmtree(self.partial)

    def _check_settings(self, settings: Mapping[str, Any]) -> None:
        path = self.partial / JOB
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise SequenceError(path, "can't be read: remove the unfinished job") from None
        now = json.loads(json.dumps(settings))
        for key in sorted({*before, *now}):
            if before.get(key) != now.get(key):
                raise SequenceError(
                    path,
                    f"the job was started with {key}={before.get(key)}, not {now.get(key)}: "
                    "continue it as it was started, or remove it",
                )


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a JSON file atomically."""
    fresh = path.with_name(f"{path.name}.tmp")
    fresh.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    fresh.replace(path)
