"""An agent beside baselines on the same episodes: rows for evaluation.csv and a table to read."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from rich import box
from rich.console import Console
from rich.table import Table
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import RandomPolicy
from tqdm.auto import tqdm

from flowrep.experiment.evaluation import (
    OUTCOMES,
    Episode,
    Policy,
    outcome_shares,
    run_episodes,
)

Row = dict[str, Any]
BASELINES = ("never_turn", "random")


def never_turn(tensordict: TensorDictBase) -> TensorDictBase:
    """Writes the action NO_OP: drives on as at the start."""
    shape = tensordict.batch_size
    return tensordict.set("action", torch.zeros(shape, dtype=torch.long))


def compare(
    agents: Mapping[str, Policy],
    make_env: Callable[..., EnvBase],
    *,
    speeds: Sequence[str],
    fps: Sequence[float],
    episodes: int,
    seed: int,
    baselines: bool = True,
    should_stop: Callable[[], bool] = lambda: False,
) -> list[Row]:
    """Returns one row an episode, for every policy, speed and frame rate.

    Args:
        agents: "greedy" and / or "sampled" → the policy that is run in that way.
        make_env: called with `speed`, `frame_rate_hz` and, for baselines, which see nothing,
            `representations=()`.
        speeds: pedestrians' speed modes.
        fps: frame rates in Hz.
        episodes: for each policy, speed and frame rate.
        seed: of the environments; the same for every policy, so that the episodes are too.
        baselines: whether to run `never_turn` and random actions as well.
        should_stop: asked between steps; the rows of unfinished policies are left out.
    """
    rows: list[Row] = []
    names = [*agents, *(BASELINES if baselines else ())]
    total = len(names) * len(speeds) * len(fps) * episodes
    with tqdm(total=total, unit="episode", desc="evaluating") as bar:
        for speed in speeds:
            for rate in fps:
                for name in names:
                    blind = {} if name in agents else {"representations": ()}
                    env = make_env(speed=speed, frame_rate_hz=rate, **blind)
                    policy = agents.get(name) or _baseline(name, env, seed)
                    env.set_seed(seed)
                    finished = run_episodes(
                        env,
                        policy,
                        episodes,
                        greedy=name != "sampled",
                        should_stop=should_stop,
                        on_episode=bar.update,
                    )
                    env.close()
                    if should_stop():
                        return rows
                    rows += [_row(name, speed, rate, episode) for episode in finished]
    return rows


def with_origin(rows: Sequence[Row], config: Mapping[str, Any], frames: int) -> list[Row]:
    """Returns the rows with the columns that say whose they are, in evaluation.csv's order."""
    origin = {
        "scene": config["scene"]["name"],
        "representations": "+".join(config["representations"]),
        "seed": config["seed"],
        "frames": frames,
    }
    return [origin | row for row in rows]


def _baseline(name: str, env: EnvBase, seed: int) -> Policy:
    if name == "never_turn":
        return never_turn
    torch.manual_seed(seed)
    return RandomPolicy(env.action_spec)


def _row(policy: str, speed: str, fps: float, episode: Episode) -> Row:
    return {
        "policy": policy,
        "speed": speed,
        "fps": fps,
        "episode_seed": episode.episode_seed,
        "outcome": episode.outcome,
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
    (console or Console(width=max(88, Console().width))).print(table)
