"""The ending of a sweep's run, kept in its folder."""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

FINISHED: Final = "finished"
FAILED: Final = "failed"
STOPPED: Final = "stopped"
LOG = "job.log"


@dataclass(frozen=True)
class Ending:
    """How the last attempt at a run ended.

    Args:
        how: "finished" is final; other runs are tried again when the sweep is continued.
        success: a finished run's share of greedy episodes that succeed.
        message: the error of a failed run, in one line.
    """

    how: Literal["finished", "failed", "stopped"]
    success: float | None = None
    message: str = ""

    def write(self, folder: Path) -> None:
        """Writes it to a run's folder."""
        whole = folder / "ending.json.tmp"
        whole.write_text(json.dumps(asdict(self)) + "\n", encoding="utf-8")
        whole.replace(folder / "ending.json")

    def keep(self, folder: Path) -> None:
        """Writes it to a run's folder; if that fails, prints it, and this process remembers it."""
        try:
            self.write(folder)
        except OSError as error:
            _UNWRITTEN[folder.resolve()] = self
            print(f"{folder}: {self.how}: {self.message} (not saved: {error})", file=sys.stderr)

    @classmethod
    def read(cls, folder: Path) -> "Ending | None":
        """Returns the ending in a run's folder, None while the run has not ended."""
        if folder.resolve() in _UNWRITTEN:
            return _UNWRITTEN[folder.resolve()]
        try:
            return cls(**json.loads((folder / "ending.json").read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    @staticmethod
    def forget(folder: Path) -> None:
        """Removes the ending from a run's folder."""
        _UNWRITTEN.pop(folder.resolve(), None)
        (folder / "ending.json").unlink(missing_ok=True)


_UNWRITTEN: dict[Path, Ending] = {}  # by folder
