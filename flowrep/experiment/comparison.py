"""Agents and baselines on the same episodes: rows for evaluation.csv and a table to read."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table
from tqdm.auto import tqdm

from flowrep.experiment.arena import Job
from flowrep.experiment.arena_team import AnyArena
from flowrep.experiment.env_pool import Options
from flowrep.experiment.evaluation import OUTCOMES, Episode, outcome_shares

Row = dict[str, Any]


class _Cell(NamedTuple):
    """A group of episodes: the agent (None for a baseline), policy, speed and frame rate."""

    agent: int | None
    policy: str
    speed: str
    fps: float


class Comparison:
    """The episodes to run, and the results so far.

    Episode k of each policy, speed and frame rate has the seed `seed + k`.

    Args:
        speeds: pedestrians' speed modes.
        fps: frame rates in Hz.
        episodes: their number for each policy, speed and frame rate.
        seed: the seed of the first episode.
        policies: "greedy", "sampled" or both, applied to every agent, or the name of a policy with
            only one way to act.
        baselines: names in `flowrep.baselines.BASELINES`, run on the same episodes.
        agents: the number of agents.
    """

    def __init__(
        self,
        *,
        speeds: Sequence[str],
        fps: Sequence[float],
        episodes: int,
        seed: int,
        policies: Sequence[str],
        baselines: Sequence[str] = (),
        agents: int = 1,
    ) -> None:
        self._seeds = [(seed + k) % (1 << 31) for k in range(episodes)]
        # ordered by agent and frame rate, so that environments share a batch for long
        self._rides = [
            _Cell(agent, policy, speed, rate)
            for agent, rate, speed, policy in product(range(agents), fps, speeds, policies)
        ]
        self._drives = [
            _Cell(None, name, speed, rate) for rate, speed, name in product(fps, speeds, baselines)
        ]
        self._conditions = list(product(speeds, fps))
        self._names = ([*policies], [*baselines])
        self._done: dict[_Cell, dict[int, Episode]] = defaultdict(dict)

    @property
    def rides(self) -> int:
        """The number of episodes that agents are to drive."""
        return len(self._rides) * len(self._seeds)

    @property
    def is_complete(self) -> bool:
        """Returns whether all episodes have been run."""
        cells = [*self._rides, *self._drives]
        return all(len(self._done[cell]) == len(self._seeds) for cell in cells)

    def run(
        self,
        arena: AnyArena,
        should_stop: Callable[[], bool] = lambda: False,
        save: Callable[[int], None] = lambda agent: None,
    ) -> None:
        """Runs the episodes; finished ones are kept even if it is interrupted.

        Args:
            arena: an arena with as many agents.
            should_stop: called after each episode.
            save: called with an agent's number when all its episodes with one policy, speed and
                frame rate have been run.
        """
        count = len(self._seeds)
        rides = [(cell, k) for cell in self._rides for k in range(count)]
        drives = [(cell, k) for cell in self._drives for k in range(count)]
        jobs = [
            Job(cell.agent or 0, cell.policy != "sampled", cell.speed, cell.fps, self._seeds[k])
            for cell, k in rides
        ]
        driven = [(cell.policy, self._options(cell, k)) for cell, k in drives]
        total = len(rides) + len(drives)
        with tqdm(total=total, unit="episode", desc="evaluating", leave=False) as bar:
            for number, episode in arena.run(jobs):
                cell, k = rides[number]
                self._done[cell][k] = episode
                bar.update()
                if len(self._done[cell]) == count:
                    save(jobs[number].agent)
                if should_stop():
                    return
            for number, drive in arena.drive(driven):
                ended = drive.outcome, drive.hit, drive.total_reward, drive.steps
                cell, k = drives[number]
                self._done[cell][k] = Episode(drive.episode_seed, *ended)
                bar.update()
                if should_stop():
                    return

    def rows(self, agent: int = 0) -> list[Row]:
        """Returns a row for each episode of an agent and of the baselines, in their order.

        Of an incomplete group, only the episodes before the first gap are returned: short episodes
        finish first, so taking all that are done would bias the result.
        """
        rows = []
        policies, baselines = self._names
        for speed, rate in self._conditions:
            cells = [_Cell(agent, name, speed, rate) for name in policies]
            cells += [_Cell(None, name, speed, rate) for name in baselines]
            for cell in cells:
                episodes, k = self._done[cell], 0
                while k in episodes:
                    rows.append(_row(cell, episodes[k]))
                    k += 1
        return rows

    def _options(self, cell: _Cell, k: int) -> Options:
        return {"episode_seed": self._seeds[k], "speed": cell.speed, "frame_rate_hz": cell.fps}


def with_origin(
    rows: Sequence[Row], config: Mapping[str, Any], frames: int, evaluation: str
) -> list[Row]:
    """Returns the rows with the columns that identify the run, in evaluation.csv's order.

    Args:
        rows: from `Comparison.rows`.
        config: the config of the evaluated agent's run.
        frames: the frames that the agent was trained for.
        evaluation: "training", "final" or "evaluate".
    """
    origin = {
        "scene": config["scene"]["name"],
        "representations": "+".join(config["representations"]),
        "flow": config["flow"]["source"],
        "seed": config["seed"],
        "frames": frames,
        "evaluation": evaluation,
    }
    return [origin | row for row in rows]


def _row(cell: _Cell, episode: Episode) -> Row:
    return {
        "policy": cell.policy,
        "speed": cell.speed,
        "fps": cell.fps,
        "episode_seed": episode.episode_seed,
        "outcome": episode.outcome,
        "hit": episode.hit,
        "return": round(episode.total_reward, 4),
        "length": episode.length,
    }


def print_table(rows: Sequence[Mapping[str, Any]], console: Console | None = None) -> None:
    """Prints the share of each outcome in %, with its 95 % Wilson interval."""
    table = Table(title="Share of episodes in % [95 % interval]", box=box.SIMPLE, pad_edge=False)
    for heading in ("speed", "fps", "policy", "episodes"):
        table.add_column(heading, no_wrap=heading != "policy", overflow="fold")  # it may be a path
    for heading in OUTCOMES[1:]:
        table.add_column(heading.replace("_", " "), justify="right", no_wrap=True)
    by_policy: dict[tuple[str, float, str], list[str]] = defaultdict(list)
    for row in rows:
        by_policy[row["speed"], row["fps"], row["policy"]].append(row["outcome"])
    shown: tuple[str, float] | None = None
    for (speed, fps, policy), outcomes in by_policy.items():
        if shown not in (None, (speed, fps)):
            table.add_section()
        shown = speed, fps
        shares = outcome_shares(outcomes).values()
        cells = [f"{100 * s:.0f} [{100 * low:.0f}–{100 * high:.0f}]" for s, low, high in shares]
        table.add_row(speed, f"{float(fps):g}", policy, str(len(outcomes)), *cells)
    (console or Console(width=max(100, Console().width))).print(table)
