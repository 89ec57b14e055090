"""The tables of a report on runs."""

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

from flowrep.report.cell_text import MISSING, p_text, percent, points, ratio
from flowrep.report.figures import words
from flowrep.report.runs import (
    Condition,
    Run,
    SuccessGrid,
    changes,
    departures,
    in_order,
    in_stacks,
    paired_scores,
    scenes_of,
    scores_of,
)
from flowrep.report.statistics import Estimate, effect, holm, improvement, mean_share

INTERVALS = (
    "the mean over seeds with its 95 % t interval; for a single seed, or seeds with equal rates, "
    "Wilson's interval over the episodes"
)
_MOST_PAIRS = 15  # in a table
# The rows of the paper's Table III.
_TABLE_III = ("ego+obj", "depth2", "seg2", "ego+obj+depth2", "ego+obj+seg2", "ego+obj+seg2+depth2")


class Table(NamedTuple):
    """A table of texts; its rows are grouped in blocks."""

    name: str  # of its files
    caption: str
    header: tuple[str, ...]
    blocks: tuple[tuple[str, tuple[tuple[str, ...], ...]], ...]  # headings, "" for none, and rows
    words: tuple[int, ...] = ()  # columns that are aligned left, apart from the first

    @property
    def alignment(self) -> str:
        """A letter for each column, "l" or "r"."""
        return "".join("l" if i in (0, *self.words) else "r" for i in range(len(self.header)))

    def to_csv(self) -> str:
        """Returns a CSV table; a block's heading is its rows' first cell."""
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        first = 0 if any(heading for heading, _ in self.blocks) else 1
        for heading, rows in (("group", (self.header,)), *self.blocks):
            writer.writerows((heading, *row)[first:] for row in rows)
        return text.getvalue()


def success_table(name: str, grids: Sequence[SuccessGrid], caption: str) -> Table:
    """Returns the success of each stack and baseline, in a block for each scene."""
    _, series, conditions, *_ = grids[0]
    blocks = []
    for grid in grids:
        rows = []
        for one in series:
            cells = [grid.cells[one, c] for c in conditions if (one, c) in grid.cells]
            counts = dict.fromkeys(cell.counts for cell in cells)
            rows.append((one, *_shares(grid, one), ", ".join(counts) or "0"))
        for baseline in dict.fromkeys(baseline for baseline, _ in grid.baselines):
            shares = [grid.baselines.get((baseline, c)) for c in conditions]
            texts = [MISSING if share is None else f"{100 * share:.0f}" for share in shares]
            rows.append((baseline.replace("_", " "), *texts, ""))
        blocks.append((words(grid.scene), tuple(rows)))
    # A mean over scenes needs every scene: without the hard ones, a stack would look better.
    if len(grids) > 1:

        def over_all(key: tuple[str, Condition]) -> str:
            rates = [grid.cells[key].rates for grid in grids if key in grid.cells]
            return percent(mean_share(rates)) if len(rates) == len(grids) else MISSING

        rows = [(one, *(over_all((one, c)) for c in conditions), "") for one in series]
        blocks.append((f"All {len(grids)} scenes", tuple(rows)))
    header = ("representations", *(f"{c.speed} (%)" for c in conditions), "seeds × episodes")
    return Table(f"{name}_success", f"In %. {caption}", header, tuple(blocks))


def differences_table(
    name: str,
    series: Mapping[str, Sequence[Run]],
    scenes: Sequence[str],
    conditions: Sequence[Condition],
    pairs: Sequence[tuple[str, str]],
) -> Table:
    """Returns the tests of `pairs` of stacks, in a block for each scene and for all of them."""
    asked = [pair for pair in pairs if {*pair} <= {*series}]
    chosen = asked[:_MOST_PAIRS]
    headings = {words(scene): [scene] for scene in scenes}
    if len(scenes) > 1:
        headings[f"All {len(scenes)} scenes"] = list(scenes)
    blocks = []
    for heading, here in headings.items():
        scored = {}  # of each pair and speed, by scene: rates of both sides, number of episodes
        for pair, condition in product(chosen, conditions):
            sides = [[[r for r in series[s] if r.scene == scene] for s in pair] for scene in here]
            of_scenes = [paired_scores(of, [condition]) for of in sides]
            if None not in of_scenes:
                scored[pair, condition.speed] = list(filter(None, of_scenes))
        rates = [[both for both, _ in of_scenes] for of_scenes in scored.values()]
        effects = list(map(effect, rates))
        # One family a block: whoever reads a scene's table sees all of its comparisons at once.
        corrected = holm([each.p_value for each in effects])
        rows = []
        for (pair, speed), each, both, p in zip(scored, effects, rates, corrected):
            shared = sum(number for _, number in scored[pair, speed])
            cells = (points(each.interval()), each.verdict(p), p_text(each.p_value), p_text(p))
            better = f"{100 * improvement(both):.0f}"
            rows.append((" − ".join(pair), speed, *cells, better, str(shared)))
        blocks += [(heading, tuple(rows))] if rows else []
    caption = (
        "First minus second in percentage points, on the episodes that all runs of both drove, "
        "with 95 % intervals and p of Welch's t-test over seeds; p (Holm) is corrected for the "
        "comparisons of its block, and a difference is significant if it is below 0.05. "
        "P(first better) is how often a run of the first beats one of the second; "
        "a tie counts half."
    )
    if len(chosen) < len(asked):
        caption += f" The first {len(chosen)} of {len(asked)} pairs."
    columns = ("speed", "points", "verdict", "p", "p (Holm)", "P(first better) (%)", "shared")
    header = ("first − second", *columns)
    return Table(f"{name}_differences", caption, header, tuple(blocks), (1, 3))


def failure_table(runs: Sequence[Run], conditions: Sequence[Condition]) -> Table:
    """Returns the paper's Table III: the shares of departures and collisions among failures."""
    stacks = in_order([run.stack for run in runs], _TABLE_III)
    blocks = []
    # The paper's table is of S-Turn, which therefore comes first.
    for scene in in_order(scenes_of(runs), ("s_turn",)):
        here = in_stacks([run for run in runs if run.scene == scene])
        rows = [(stack, *_failure_cells(here.get(stack, []), conditions)) for stack in stacks]
        blocks.append((words(scene), tuple(rows)))
    policy, _, fps = conditions[0]
    caption = (
        "Causes of failure in % of all collisions and departures from the road of a run, "
        f"without time-outs: {INTERVALS}. {words(' and '.join(c.speed for c in conditions))} "
        f"speed, {fps:g} frames per second, {policy} actions."
    )
    header = ("representations", "out of bounds (%)", "collision (%)", "out of bounds to collision")
    counts = ("failures", "time-outs", "episodes")
    return Table("failure_causes", caption, (*header, *counts), tuple(blocks))


def _failure_cells(runs: Sequence[Run], conditions: Sequence[Condition]) -> tuple[str, ...]:
    ours = [run for run in runs if run.conditions.issuperset(conditions)]
    if not ours:
        return (*[MISSING] * 3, "0", "0", "0")
    ends = Counter(str(end) for r in ours for c in conditions for end in r.under(c)["outcome"])
    failures = ends["out_of_bounds"] + ends["collision"]
    counted = (str(failures), str(ends["timeout"]), str(ends.total()))
    shares = scores_of(ours, conditions, departures)
    if not len(shares):
        return (*["no failures"] * 3, *counted)
    # The rate of a run is a share of its failures, of which an average run has so many.
    share = mean_share([shares], failures // len(shares))
    # The rest of the failures: the bounds change places.
    collisions = Estimate(1 - share.value, 1 - share.high, 1 - share.low)
    return (percent(share, 1), percent(collisions, 1), ratio(share), *counted)


def rate_table(
    grids: Sequence[SuccessGrid], series: Mapping[str, Sequence[Run]], caption: str
) -> Table:
    """Returns the success of each stack by frame rate, and its change from highest to lowest."""
    conditions = grids[0].conditions
    low, high = conditions[0], conditions[-1]
    blocks = []
    for grid in grids:
        rows = []
        for name, members in series.items():
            lost = changes([run for run in members if run.scene == grid.scene], high, low)
            loss = points(effect([(lost,)]).interval()) if len(lost) else MISSING
            rows.append((name, *_shares(grid, name), loss))
        blocks.append((words(grid.scene), tuple(rows)))
    heads = (*(f"{c.fps:g} Hz (%)" for c in conditions), f"{high.fps:g} → {low.fps:g} Hz (points)")
    of_table = f"In %. {caption} The last column is the change of one agent on the same episodes."
    return Table("frame_rate_success", of_table, ("representations", *heads), tuple(blocks))


def _shares(grid: SuccessGrid, series: str) -> list[str]:
    cells = [grid.cells.get((series, c)) for c in grid.conditions]
    return [percent(cell.score) if cell else MISSING for cell in cells]
