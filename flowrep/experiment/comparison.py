"""An agent beside baselines on the same episodes: rows for evaluation.csv and a table to read."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from torchrl.envs import EnvBase
from tqdm.auto import tqdm

from flowrep.envs import streets
from flowrep.envs.baselines import BASELINES, drives
from flowrep.experiment.evaluation import (
    OUTCOMES,
    Episode,
    Policy,
    outcome_shares,
    quotas,
    run_episodes,
)

Row = dict[str, Any]


def compare(
    agents: Mapping[str, Policy],
    make_env: Callable[..., EnvBase],
    *,
    speeds: Sequence[str],
    fps: Sequence[float],
    episodes: int,
    seed: int,
    baselines: Sequence[str] = (),
    should_stop: Callable[[], bool] = lambda: False,
) -> list[Row]:
    """Returns one row an episode, for every speed, frame rate and policy.

    Args:
        agents: "greedy" and / or "sampled" → the policy that is run in that way.
        make_env: called with `speed` and `frame_rate_hz`, and, for the street that baselines drive
            through, `representations`, `num_envs` and `num_workers`.
        speeds: pedestrians' speed modes.
        fps: frame rates in Hz.
        episodes: for each policy, speed and frame rate.
        seed: of the environments; the same for every policy, so that the episodes are too.
        baselines: names in `flowrep.envs.baselines.BASELINES`, run on the same episodes.
        should_stop: asked between steps; the rows of unfinished policies are left out.
    """
    rows: list[Row] = []
    total = len(speeds) * len(fps) * (len(agents) + len(baselines)) * episodes
    with tqdm(total=total, unit="episode", desc="evaluating", leave=False) as bar:
        for speed, rate in product(speeds, fps):
            make = partial(make_env, speed=speed, frame_rate_hz=rate)
            env = make()
            split = quotas(episodes, env.batch_size.numel())
            runs: dict[str, partial[Iterator[Episode]]] = {
                name: partial(
                    run_episodes, env, policy, episodes, seed=seed, greedy=name != "sampled"
                )
                for name, policy in agents.items()
            } | {
                name: partial(baseline_episodes, make, name, split, seed=seed) for name in baselines
            }
            for name, run in runs.items():
                finished = []
                for episode in run():
                    finished.append(_row(name, speed, rate, episode))
                    bar.update()
                    if should_stop():
                        env.close()
                        return rows
                rows += finished
            env.close()
    return rows


def baseline_episodes(
    make_env: Callable[..., EnvBase], name: str, split: Sequence[int], *, seed: int
) -> Iterator[Episode]:
    """Yields the episodes that `run_episodes` runs, driven by a baseline, which sees no picture.

    Args:
        make_env: called with `representations`, `num_envs` and `num_workers`; its one street is
            driven through, for each environment of the batch in turn.
        name: in `flowrep.envs.baselines.BASELINES`.
        split: how many episodes each environment of the batch runs, see `quotas`.
        seed: of the environments.
    """
    env = make_env(representations=(), num_envs=1, num_workers=0)
    (street,), driver = streets(env), BASELINES[name]()
    for number, quota in enumerate(split):
        street.reset(seed=seed + number)
        for drive in drives(street, driver, quota):
            yield Episode(
                drive.episode_seed, drive.outcome, drive.hit, drive.total_reward, drive.steps
            )
    env.close()


def with_origin(
    rows: Sequence[Row], config: Mapping[str, Any], frames: int, evaluation: str
) -> list[Row]:
    """Returns the rows with the columns that say whose they are, in evaluation.csv's order.

    Args:
        rows: from `compare`.
        config: of the run whose agent was evaluated.
        frames: that it had been trained for.
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


def _row(policy: str, speed: str, fps: float, episode: Episode) -> Row:
    return {
        "policy": policy,
        "speed": speed,
        "fps": fps,
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
        table.add_column(heading, no_wrap=True)
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
