"""How episodes ended: the rows of evaluation.csv, whether a run is finished, and its success.

The workers of a sweep import this module, so it imports no PyTorch.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from flowrep.files import finite_number, read_rows, whole_number

if TYPE_CHECKING:
    from flowrep.experiment.schema import TrainConfig

OUTCOMES = ("success", "collision", "out_of_bounds", "timeout")
"""How an episode can end. Repeated here, as `flowrep.envs`, which defines it, needs PyBullet."""

CAUSES = ("out of bounds", "collision: pedestrian", "collision: other", "timeout")

Cell = TypeVar("Cell")
Key = Annotated[Cell, "key"]  # tells a run's episodes apart
Result = Annotated[Cell, "result"]  # what happened in the episode
Implied = Annotated[Cell, "implied"]  # follows from the others and the run's config


@dataclass(frozen=True, kw_only=True)
class EpisodeRecord:
    """One evaluated episode. All fields but the last are the columns of evaluation.csv."""

    # The agent; `evaluate` leaves these empty, and `PairedEvaluation.records` fills them in.
    scene: Key[str] = ""
    scene_id: Key[str] = ""  # a hash of all that defines the scene
    representations: Implied[str] = ""  # "ego+obj"
    flow: Implied[str] = ""  # "exact" or "estimated"
    seed: Implied[int | str] = ""  # of the agent's run; "" for a policy without one
    frames: Key[int] = 0  # of the agent's training
    evaluation: Key[str] = ""  # "training", "final" or "evaluate"
    policy: Key[str] = ""  # "greedy", "sampled", or the name of another policy
    # The conditions.
    speed: Key[str]  # the pedestrians' speed mode; "" for the env's default
    fps: Key[float]
    episode_seed: Key[int]  # determines path and people, see `StreetEnv.reset`
    path: Result[str]  # the name of the scene's path that the episode drew or was given
    # How it ended.
    outcome: Result[str]  # one of `OUTCOMES`
    hit: Result[str]  # the category that was hit, or ""
    return_: Implied[float]  # undiscounted sum of rewards
    length: Result[int]  # the number of steps T
    # The vehicle's x and y in metres, `[T + 1, 2]`.
    positions: NDArray[np.float32] = field(repr=False, compare=False)

    def row(self) -> dict[str, Any]:
        """Returns the episode's row in evaluation.csv, by column."""
        # A field can't be named `return`.
        row = {name: getattr(self, "return_" if name == "return" else name) for name in COLUMNS}
        return row | {"return": round(self.return_, 4)}


def columns_for(*uses: str) -> dict[str, type]:
    """Returns the columns of evaluation.csv for these uses, in order, with the types of cells."""
    hints = get_type_hints(EpisodeRecord, include_extras=True)
    annotated = {name.rstrip("_"): get_args(hint) for name, hint in [*hints.items()][:-1]}
    types = {name: kind for name, (kind, use) in annotated.items() if use in uses}
    return {name: kind if kind in (int, float) else str for name, kind in types.items()}


COLUMNS = columns_for("key", "result", "implied")
_LATER = ("scene_id", "path")  # columns that older tables lack; they are read as empty
_OF_TYPE: dict[type, Callable[[str], Any]] = {int: whole_number, float: finite_number}
# A misspelt outcome would count as a failure.
_CHECKS = {name: _OF_TYPE[kind] for name, kind in COLUMNS.items() if kind is not str} | {
    "outcome": OUTCOMES.index
}


def read_episodes(path: Path) -> list[dict[str, str]]:
    """Returns the rows of an evaluation.csv, none if there is no such file."""
    needed = [name for name in COLUMNS if name not in _LATER]
    rows = read_rows(path, needed, _CHECKS)
    return [{name: row.get(name, "") for name in COLUMNS} for row in rows]


def is_finished(folder: Path, config: TrainConfig) -> bool:
    """Returns whether a run's final evaluation is in its folder."""
    # A run that was made longer keeps the final evaluation of its earlier, shorter self.
    frames = [int(row["frames"]) for row in _final_rows(folder)]
    enough = sum(each >= config.total_frames for each in frames)
    return enough >= config.evaluation.final_total


def success_of(folder: Path) -> float:
    """Returns the agent's success in a run's last final evaluation; nan without one.

    It is that of greedy actions, or of sampled ones if these alone were evaluated.
    """
    rows = _final_rows(folder)
    for policy in ("greedy", "sampled"):
        acted = [row for row in rows if row["policy"] == policy]
        last = max((int(row["frames"]) for row in acted), default=0)
        if ends := [row["outcome"] for row in acted if int(row["frames"]) == last]:
            return ends.count("success") / len(ends)
    return float("nan")


def _final_rows(folder: Path) -> list[dict[str, str]]:
    rows = read_episodes(folder / "evaluation.csv")
    return [row for row in rows if row["evaluation"] == "final"]


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Returns Wilson's 95 % score interval of a proportion; (0, 1) without trials."""
    # Not scipy's, which a training needn't have installed.
    if not trials:
        return 0.0, 1.0
    # The proportions p from which the observed share is at most z standard errors away: the
    # solutions of (share - p)² = z² p (1 - p) / trials.
    z2 = NormalDist().inv_cdf(0.975) ** 2
    share = successes / trials
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = (z2 * share * (1 - share) / trials + z2**2 / (4 * trials**2)) ** 0.5 / (1 + z2 / trials)
    # Rounding may leave an end an ulp on the wrong side of the share, or outside of [0, 1].
    return max(0.0, min(share, centre - half)), min(1.0, max(share, centre + half))


def outcome_shares(outcomes: Iterable[str]) -> dict[str, tuple[float, float, float]]:
    """Returns the share of each outcome, with its 95 % Wilson interval."""
    counts = Counter(outcomes)
    trials = counts.total()
    return {
        name: (counts[name] / max(trials, 1), *wilson_interval(counts[name], trials))
        for name in OUTCOMES
    }


def failure_causes(rows: Iterable[Mapping[str, Any]]) -> Counter[str]:
    """Returns how many episodes failed by each of `CAUSES`, which are the paper's Table III."""
    causes: Counter[str] = Counter()
    for row in rows:
        cause = row["outcome"].replace("_", " ")
        if cause == "collision":
            cause += ": pedestrian" if row["hit"] == "pedestrian" else ": other"
        # Adds 0 for a success, which is then no part of the total.
        causes[cause] += cause != "success"
    return causes


def print_results(rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints the share of each outcome, and the causes of failure, by policy and speed."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[row["speed"], f"{float(row['fps']):g}", row["policy"]].append(row)
    shares, causes = [], []
    for key, episodes in groups.items():
        named = dict(zip(("speed", "fps", "policy"), key))
        cells = {
            name: f"{100 * share:.0f} [{100 * low:.0f}–{100 * high:.0f}]"
            for name, (share, low, high) in outcome_shares(e["outcome"] for e in episodes).items()
        }
        shares.append(named | {"episodes": len(episodes)} | cells)
        failed = failure_causes(episodes)
        total = failed.total()
        cells = {cause: f"{100 * failed[cause] / total:.0f}" if total else "" for cause in CAUSES}
        causes.append(named | {"failures": f"{total} of {len(episodes)}"} | cells)
    print_table("Share of episodes in % [95 % interval]", shares)
    print_table("Causes of failure in % of the failures", causes)


def print_table(title: str, rows: Sequence[Mapping[str, Any]], least_width: int = 100) -> None:
    """Prints rows with the same keys, the headings, in `least_width` columns or the terminal's."""
    table = Table(title=title, box=box.SIMPLE, pad_edge=False)
    for name in rows[0]:
        heading = name.replace("_", " ").replace(": ", ":\n")
        is_number = all(str(row[name])[:1] in "-+−<0123456789" for row in rows)
        side: Any = "right" if is_number else "left"
        # A policy's name may be a long path: it is folded, numbers are not.
        table.add_column(heading, justify=side, no_wrap=name != "policy", overflow="fold")
    for row in rows:
        table.add_row(*map(str, row.values()))
    # Names are text: a[b] is no markup, :car: no emoji.
    console = Console(width=max(least_width, Console().width), markup=False, emoji=False)
    console.print(table)
