"""Starts, watches and sums up a sweep from the command line."""

import sys
import traceback
from collections.abc import Sequence

import hydra
from rich.console import Console

from flowrep.config import UsageError
from flowrep.config.command_line import exit_with
from flowrep.config.composition import VERSION_BASE
from flowrep.config.quoting import override, shell_line
from flowrep.config_tree import CONF_DIR
from flowrep.sweeps.display import Display, said
from flowrep.sweeps.ending import FAILED, FINISHED, LOG, Ending
from flowrep.sweeps.job import job
from flowrep.sweeps.plan import Plan, plan_of
from flowrep.sweeps.standing import Standing, standings_of
from flowrep.sweeps.stopping import SweepStop

_NO_RESULT = "No trials are completed"  # says Optuna if all failed or were stopped; so do we


def run_sweep(config_name: str) -> None:
    """Runs the sweep of `sys.argv`, which has been checked, and ends the process.

    The exit code is 0 if all runs have finished, that of a signal that stopped it, else 1.
    """
    try:
        plan = plan_of(config_name, sys.argv[1:])
    except UsageError as error:
        exit_with(error)
    try:
        plan.folder.mkdir(parents=True, exist_ok=True)
        for folder in plan.folders():
            ending = Ending.read(folder)
            if ending is not None and ending.how != FINISHED:
                Ending.forget(folder)  # it is tried again
    except OSError as error:
        exit_with(f"the sweep's folder can't be used ({error}): give another with hydra.sweep.dir=")
    given = override("hydra.sweep.dir", str(plan.folder))
    typed = [text for text in sys.argv[1:] if not text.startswith("hydra.sweep.dir=")]
    again = shell_line("python", "-m", f"flowrep.{config_name}", *typed, given)
    sys.argv[1:] = [*typed, given, *plan.options]
    command = hydra.main(
        version_base=VERSION_BASE, config_path=str(CONF_DIR), config_name=config_name
    )(job)
    failure = 0
    with SweepStop(plan.folder) as stop:
        try:
            with Display(lambda: standings_of(plan.folders()), plan.total):
                command()
        except KeyboardInterrupt:
            failure = 130
        except SystemExit as end:
            failure = end.code if isinstance(end.code, int) else 1
        except Exception as error:  # of the launcher or the sweeper
            failure = 1
            if _NO_RESULT not in str(error):
                traceback.print_exc()
    standings = standings_of(plan.folders())
    is_whole = all(s.state == FINISHED for s in standings) and not failure
    sum_up(plan, standings, "" if is_whole else again)
    if stop.received is not None:
        sys.exit(128 + stop.received)
    sys.exit(failure or int(not is_whole))


def sum_up(
    plan: Plan, standings: Sequence[Standing], again: str, console: Console | None = None
) -> None:
    """Prints how a sweep ended.

    Args:
        plan: the sweep's plan.
        standings: the states of its runs.
        again: the command that continues it; empty if nothing is left to do.
        console: the console to write to.
    """
    console = console or Console()
    finished = [s for s in standings if s.state == FINISHED]
    failed = [s for s in standings if s.state == FAILED]
    total = len(standings) if plan.total is None else plan.total
    lines = [f"sweep: {plan.folder}", f"{len(finished)} of {total} runs finished"]
    if failed:
        lines += [f"{len(failed)} failed:"]
    for standing in failed:
        lines += [f"  {said(standing)}", f"    log: {plan.folder / standing.name / LOG}"]
    if again:
        lines += ["Continue the remaining runs with", f"  {again}"]
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True, markup=False)
