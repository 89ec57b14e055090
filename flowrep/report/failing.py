"""The paper's Table III: failures out of bounds against collisions."""

from collections.abc import Sequence

import numpy as np

from flowrep.report.cells import cell_of, out_of_bounds_of_both
from flowrep.report.comparing import Settings, scenes_of
from flowrep.report.experiments import FAILURE_STACKS
from flowrep.report.results import by_stack, in_order
from flowrep.report.runs import Condition, Run
from flowrep.report.sections import MISSING, Section, listed, percent
from flowrep.report.statistics import Estimate
from flowrep.report.style import words
from flowrep.report.tables import Table

_PAPERS_SCENE = "s_turn"


def failure_section(runs: Sequence[Run], ask: Settings) -> Section:
    """Returns Table III for the scenes of the runs, the paper's scene first.

    At the speed and frame rate of training; time-outs are left out, as in the paper.
    """
    there = scenes_of(runs)
    scenes = in_order(there, (_PAPERS_SCENE,))
    stacks = in_order([run.stack for run in runs], FAILURE_STACKS)
    condition = Condition(ask.policy, runs[0].speed, runs[0].fps)
    blocks, missing = [], []
    for scene in scenes:
        here = by_stack([run for run in runs if run.scene == scene], stacks)
        rows = [failure_row(stack, here[stack], condition, ask) for stack in stacks]
        missing += [f"{row[0]} in {words(scene)}" for row in rows if MISSING in row]
        blocks.append((words(scene), tuple(rows)))
    caption = (
        "Causes of failure in % of collisions and departures from the road together, of all seeds; "
        "time-outs are left out. 95 % intervals by a bootstrap over seeds and episodes, of a "
        f"single seed Wilson's. {words(condition.speed)} speed, {condition.fps:g} frames a second, "
        f"{ask.policy} actions."
    )
    header = (
        "representations",
        "out of bounds (%)",
        "collision (%)",
        "out of bounds to collision",
        "failures",
        "time-outs",
        "episodes",
    )
    notes = (f"Missing: {listed(missing)}.",) if missing else ()
    table = Table("failure_causes", caption, header, tuple(blocks))
    return Section("failure_causes", "Causes of failure", notes, tables=(table,))


def failure_row(
    stack: str, runs: Sequence[Run], condition: Condition, ask: Settings
) -> tuple[str, ...]:
    """Returns a line of the table for the runs of one stack."""
    cell = cell_of(runs, condition, out_of_bounds_of_both)
    if cell is None:
        return (stack, *[MISSING] * 3, "0", "0", "0")
    timeouts = cell_of(runs, condition, lambda row: float(row["outcome"] == "timeout"))
    assert timeouts is not None
    share = ask.bootstrap.pooled_share(cell.outcomes)
    counted = (
        str(int((~np.isnan(cell.outcomes)).sum())),
        str(int(np.nansum(timeouts.outcomes))),
        str(int((~np.isnan(timeouts.outcomes)).sum())),
    )
    if np.isnan(share.value):
        return (stack, *["no failures"] * 3, *counted)
    collisions = Estimate(1 - share.value, 1 - share.high, 1 - share.low)
    return (stack, _fine(share), _fine(collisions), ratio(share), *counted)


def _fine(estimate: Estimate) -> str:
    interval = percent(estimate).split(" ", 1)[1]
    return f"{100 * estimate.value:.1f} {interval}"


def ratio(share: Estimate) -> str:
    """Returns share : rest with its interval, as text.

    >>> ratio(Estimate(0.2, 0.1, 0.5))
    '0.250 [0.111–1.000]'
    """
    value, low, high = (f"{number / (1 - number):.3f}" if number < 1 else "∞" for number in share)
    return f"{value} [{low}–{high}]"
