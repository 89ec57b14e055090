"""The folder of a job: under a temporary name until it is whole, and able to be continued."""

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
    """`<output>.partial` while the job runs, `<output>` once it is whole.

    `job.json` holds the job's settings, `frames.csv` a row for each frame whose files are all
    there; whoever continues goes on after the last of them.

    Args:
        path: the folder to be.
        settings: what the job was asked for; a job continues under the same alone.
        resume: whether an unfinished job is continued.

    Raises:
        SequenceError: the folder is there already, or holds a job that can't be continued.
    """

    def __init__(self, path: str | Path, settings: Mapping[str, Any], *, resume: bool) -> None:
        self.path = Path(path)
        self.partial = self.path.with_name(f"{self.path.name}.partial")
        if self.path.exists():
            raise SequenceError(self.path, "exists already; remove it, or give another output")
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
        """Returns the index of the last frame whose files are all there."""
        try:
            rows = read_rows(self.table)
            return int(rows[-1]["index"]) if rows else None
        except (ValueError, KeyError, TypeError):
            raise SequenceError(self.table, "is not a table of frames: remove the job") from None

    def keep_rows(self, count: int) -> None:
        """Drops the rows after the first so many, and half a line at the end."""
        rows = read_rows(self.table)
        if len(rows) > count or not is_whole(self.table):
            write_rows(self.table, rows[:count], COLUMNS)

    def rows(self) -> list[dict[str, str]]:
        """Returns the rows so far."""
        return read_rows(self.table)

    def log(self, row: Mapping[str, Any]) -> None:
        """Appends a row: the frame's files are all there."""
        append_rows(self.table, [row], COLUMNS)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Gives the folder its name."""
        write_json(self.partial / SUMMARY, summary)
        self.partial.replace(self.path)

    def discard_if_empty(self) -> None:
        """Removes the folder if it was made just now and not a frame in it is whole."""
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
    """Writes a JSON file whole or not at all."""
    fresh = path.with_name(f"{path.name}.tmp")
    fresh.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    fresh.replace(path)
