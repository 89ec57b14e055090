"""Shows a sweep's progress in one place, while its runs write logs of their own."""

import threading
from collections.abc import Callable, Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from flowrep.sweeps.ending import FINISHED
from flowrep.sweeps.standing import RUNNING, WAITING, Standing

EVERY_S = 1.0


class Display:
    """Shows the state of runs: bars on a terminal, else a line whenever a run begins or ends.

    Use it as a context manager around the sweep.

    Args:
        standings: returns the current state of all runs.
        total: the number of runs of the sweep, None if unknown.
        console: the console to write to.
    """

    def __init__(
        self,
        standings: Callable[[], Sequence[Standing]],
        total: int | None,
        console: Console | None = None,
    ) -> None:
        self._standings = standings
        self._total = total
        self._console = console or Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
            refresh_per_second=2,
            disable=not self._console.is_terminal,
        )
        self._all: TaskID = self._progress.add_task("runs", total=total, note="")
        self._bars: dict[str, TaskID] = {}
        self._states: dict[str, str] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "Display":
        """Begins to watch; runs that ended before are not announced."""
        self._states = {s.name: s.state for s in self._standings() if s.state != RUNNING}
        self._progress.start()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Updates once more and restores the terminal."""
        self._over.set()
        self._thread.join()
        self.look()
        self._progress.stop()

    def look(self) -> None:
        """Shows the current state of the runs."""
        standings = self._standings()
        for standing in standings:
            if self._states.get(standing.name, WAITING) != standing.state:
                self._states[standing.name] = standing.state
                if not self._console.is_terminal and standing.state != WAITING:
                    self._console.print(
                        said(standing), highlight=False, soft_wrap=True, markup=False
                    )
            self._draw_bar(standing)
        over = [s for s in standings if s.state not in (WAITING, RUNNING)]
        finished = sum(s.state == FINISHED for s in over)
        note = f"{finished} of {self._total or '?'} finished"
        if finished < len(over):
            note += f", {len(over) - finished} not"
        self._progress.update(self._all, completed=len(over), note=note)

    def _draw_bar(self, standing: Standing) -> None:
        """Shows a bar for a run while it runs."""
        bar = self._bars.get(standing.name)
        if standing.state != RUNNING:
            if bar is not None:
                self._progress.remove_task(self._bars.pop(standing.name))
            return
        if bar is None:
            bar = self._progress.add_task(standing.name, total=None, note="")
            self._bars[standing.name] = bar
        note = "" if standing.success is None else f"success {standing.success:.0%}"
        if 0 < standing.total <= standing.frames:
            note = "evaluating"
        total = standing.total or None
        self._progress.update(bar, completed=standing.frames, total=total, note=note)

    def _watch(self) -> None:
        while not self._over.wait(EVERY_S):
            self.look()


def said(standing: Standing) -> str:
    """Returns the state of a run in one line.

    >>> said(Standing("s_turn_ego_s0", "finished", success=0.25))
    's_turn_ego_s0: finished, success 25 %'
    """
    line = f"{standing.name}: {standing.state}"
    if standing.state == FINISHED and standing.success is not None:
        line += f", success {100 * standing.success:.0f} %"
    return f"{line}: {standing.message}" if standing.message else line
