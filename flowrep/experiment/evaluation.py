"""Runs whole episodes of any policy, and makes tables of them: outcomes, causes of failure, drives.

Training, `flowrep.evaluate`, films, `flowrep.view` and baselines all drive through `evaluate`.
"""

import hashlib
import json
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import count, product
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm.auto import tqdm

from flowrep.baselines import BaselinePolicy
from flowrep.envs import Outcome
from flowrep.envs.episode import hit_name
from flowrep.scenes import Scene
from flowrep.tables import write_rows

Policy = Callable[[TensorDictBase], TensorDictBase]
Row = dict[str, Any]

OUTCOMES = tuple(outcome.label for outcome in Outcome)
"""Names of the env's `outcome` codes; each one but the first ends an episode."""

CAUSES = ("out of bounds", "collision: pedestrian", "collision: other", "timeout")
_FAILURE_GROUP = (
    "scene", "scene_id", "representations", "flow", "frames", "evaluation", "policy", "speed", "fps"
)  # fmt: skip
_WITHOUT_OBSERVATIONS: dict[str, Any] = {
    "representations": {},
    "noise": None,
    "num_workers": 0,
    "device": "cpu",
}  # baselines read the simulator
_DRAWS = 1  # separates a policy's draws from other draws of an episode's seed


@dataclass(frozen=True)
class Episode:
    """One finished episode.

    Args:
        seed: identifies it, see `StreetEnv.reset`.
        path: the name of its path.
        speed: the pedestrians' speed, as asked for; "" for the env's own.
        fps: frames per second.
        outcome: its name, one of `OUTCOMES`.
        hit: the category that was hit, or "".
        total_reward: undiscounted.
        length: number of steps T.
        positions: of the vehicle, x and y in metres, float32 `[T + 1, 2]`.
    """

    seed: int
    path: str
    speed: Any
    fps: float
    outcome: str
    hit: str
    total_reward: float
    length: int
    positions: NDArray[np.float32] = field(repr=False, compare=False)


@dataclass
class _Running:
    """An episode that a place of the batch is driving."""

    options: Mapping[str, Any]
    rng: np.random.Generator
    positions: list[list[float]]
    total_reward: float = 0.0

    @property
    def length(self) -> int:
        return len(self.positions) - 1


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: Policy,
    episodes: Iterable[Mapping[str, Any]],
    *,
    greedy: bool = True,
    on_frame: Callable[[TensorDictBase], None] | None = None,
) -> Iterator[Episode]:
    """Yields finished episodes, in the order in which they end.

    Each place of the env's batch drives one episode after the other; one that finds none left is
    idle. The policy sees the busy places alone, with two more keys for those that remember:
    `env_id` int64 `[N]`, the place, and `is_init` bool `[N, 1]`, whether its episode just began.

    Args:
        env: made by `make_env`.
        policy: writes `action` `[N]`; one that isn't greedy has `get_dist`.
        episodes: options of `StreetEnv.reset`, `episode_seed` among them.
        greedy: whether the policy's likeliest action is taken. If not, it is drawn from the
            episode's own generator, so that an episode repeats whatever else is in the batch.
        on_frame: called with the env's TensorDict after each reset and each step.
    """
    waiting = deque(episodes)
    paths = [path.name for path in env.base_env.scene.paths]
    places: list[_Running | None] = [None] * env.batch_size[0]
    tensordict: TensorDictBase | None = None
    ended = list(range(len(places)))
    while True:
        if ended:
            for i in ended:
                places[i] = _begun(waiting.popleft()) if waiting else None
            if not any(places):
                return
            tensordict = _reset(env, tensordict, ended, places)
            vehicles = tensordict["vehicle"][ended, :2].tolist()
            for i, position in zip(ended, vehicles):
                if (running := places[i]) is not None:
                    running.positions.append(position)
            if on_frame is not None:
                on_frame(tensordict)
        assert tensordict is not None
        rows = [i for i, running in enumerate(places) if running is not None]
        tensordict["action"] = _act(policy, tensordict, rows, places, greedy)
        tensordict = env.step(tensordict)["next"]
        if on_frame is not None:
            on_frame(tensordict)
        status = {
            key: tensordict[key].tolist()
            for key in ("vehicle", "reward", "outcome", "hit", "path", "episode_seed")
        }
        ended = []
        for i in rows:
            running = places[i]
            assert running is not None
            running.positions.append(status["vehicle"][i][:2])
            running.total_reward += status["reward"][i][0]
            if status["outcome"][i][0]:
                ended.append(i)
                yield Episode(
                    seed=status["episode_seed"][i][0],
                    path=paths[status["path"][i][0]],
                    speed=running.options.get("speed", ""),
                    fps=env.base_env.frame_rate_hz,
                    outcome=OUTCOMES[status["outcome"][i][0]],
                    hit=hit_name(status["hit"][i][0]),
                    total_reward=running.total_reward,
                    length=running.length,
                    positions=np.array(running.positions, dtype=np.float32),
                )


def _begun(options: Mapping[str, Any]) -> _Running:
    return _Running(options, np.random.default_rng((options["episode_seed"], _DRAWS)), [])


def _reset(
    env: EnvBase,
    tensordict: TensorDictBase | None,
    ended: Sequence[int],
    places: Sequence[_Running | None],
) -> TensorDictBase:
    """Begins the episodes of places whose last one has ended."""
    options = {"episodes": [None if p is None else dict(p.options) for p in places]}
    if tensordict is None:
        return env.reset(options=options)
    mask = torch.zeros(*env.batch_size, 1, dtype=torch.bool, device=env.device)
    mask[ended] = True
    return env.reset(tensordict.set("_reset", mask), options=options)


def _act(
    policy: Any,
    tensordict: TensorDictBase,
    rows: Sequence[int],
    places: Sequence[_Running | None],
    greedy: bool,
) -> torch.Tensor:
    """Returns actions `[num_envs]`, chosen by the policy for the given rows."""
    running = [places[i] for i in rows]
    seen = tensordict.copy() if len(rows) == len(places) else tensordict[list(rows)]
    device = tensordict.device
    seen["env_id"] = torch.tensor(rows, device=device)
    seen["is_init"] = torch.tensor([[not r.length] for r in running if r], device=device)
    actions = torch.zeros(len(places), dtype=torch.int64, device=device)
    if greedy:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            actions[rows] = policy(seen)["action"].to(device)
    else:
        shares = policy.get_dist(seen).probs.double().cumsum(-1).cpu().numpy()
        drawn = np.array([r.rng.random() for r in running if r])[:, None]
        chosen = (drawn * shares[:, -1:] >= shares[:, :-1]).sum(axis=-1)
        actions[rows] = torch.as_tensor(chosen, device=device)
    return actions


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Returns Wilson's score interval of a proportion; (0, 1) without trials.

    >>> low, high = wilson_interval(8, 10)
    >>> round(low, 3), round(high, 3)
    (0.49, 0.943)
    """
    if not trials:
        return 0.0, 1.0
    z2 = NormalDist().inv_cdf(0.5 + confidence / 2) ** 2
    share = successes / trials
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = (z2 * share * (1 - share) / trials + z2**2 / (4 * trials**2)) ** 0.5 / (1 + z2 / trials)
    # the share is within, but rounding may leave an end an ulp inside of it, or outside of [0, 1]
    return max(0.0, min(share, centre - half)), min(1.0, max(share, centre + half))


def outcome_shares(outcomes: Iterable[str]) -> dict[str, tuple[float, float, float]]:
    """Returns the share of each outcome that ends an episode, with its 95 % Wilson interval."""
    counts = Counter(outcomes)
    trials = counts.total()
    return {
        name: (counts[name] / max(trials, 1), *wilson_interval(counts[name], trials))
        for name in OUTCOMES[1:]
    }


def evaluation_seeds(first: int, count: int) -> list[int]:
    """Returns consecutive seeds of episodes, within the range that an env takes."""
    return [(first + k) % (1 << 31) for k in range(count)]


class Comparison:
    """The same episodes for an agent and baselines: which to run, and the results so far.

    Episode k of each policy, speed and frame rate has the seed `seed + k`.

    Args:
        speeds: pedestrians' speed modes.
        fps: frame rates in Hz.
        episodes: their number for each policy, speed and frame rate.
        seed: the seed of the first episode.
        policies: "greedy", "sampled" or both; or the name of a policy with only one way to act.
        baselines: names in `flowrep.baselines.BASELINES`.
    """

    def __init__(
        self,
        *,
        speeds: Sequence[str],
        fps: Sequence[float],
        episodes: int,
        seed: int,
        policies: Sequence[str] = ("greedy",),
        baselines: Sequence[str] = (),
    ) -> None:
        self.speeds, self.fps = [*speeds], [float(rate) for rate in fps]
        self.policies, self.baselines = [*policies], [*baselines]
        self._seeds = evaluation_seeds(seed, episodes)
        self._found: dict[tuple[str, float, str], dict[int, Episode]] = defaultdict(dict)

    @property
    def total(self) -> int:
        """The number of episodes to run."""
        names = len(self.policies) + len(self.baselines)
        return len(self.speeds) * len(self.fps) * names * len(self._seeds)

    @property
    def is_complete(self) -> bool:
        """Whether all episodes have been run."""
        return sum(map(len, self._found.values())) == self.total

    def run(
        self,
        make_env: Callable[..., EnvBase],
        policy: Policy,
        num_envs: int,
        should_stop: Callable[[], bool] = lambda: False,
        save: Callable[[], None] = lambda: None,
        pool: Any = None,
    ) -> None:
        """Runs the episodes; finished ones are kept even if it is interrupted.

        A second run, of another agent in the same scene, keeps the baselines' episodes.

        Args:
            make_env: called with changes of `make_env`'s arguments for each frame rate.
            policy: the agent's.
            num_envs: the number of environments side by side, at most.
            should_stop: called after each episode.
            save: called when all episodes of a policy at one speed and frame rate have been run.
            pool: an `EvaluationPool`, whose processes run the episodes; this one does if None.
        """
        for key in list(self._found):
            if key[-1] in self.policies:
                del self._found[key]
        done = sum(map(len, self._found.values()))
        steps = count(1)

        def show_step(_: TensorDictBase) -> None:
            """Shows that the bar is alive: the first episodes end after seconds, many at once."""
            bar.set_postfix_str(f"step {next(steps)}", refresh=False)
            bar.update(0)

        with tqdm(
            total=self.total, initial=done, unit="episode", desc="evaluating", leave=False,
            miniters=0, mininterval=0.5,
        ) as bar:  # fmt: skip
            driven = self._episodes(make_env, policy, num_envs, show_step, should_stop, pool)
            for name, episode in driven:
                found = self._found[episode.speed, episode.fps, name]
                found[episode.seed] = episode
                bar.update()
                if len(found) == len(self._seeds):
                    save()
                if should_stop():
                    return

    def _episodes(
        self,
        make_env: Callable[..., EnvBase],
        policy: Policy,
        num_envs: int,
        on_frame: Callable[[TensorDictBase], None],
        should_stop: Callable[[], bool],
        pool: Any,
    ) -> Iterator[tuple[str, Episode]]:
        for rate in self.fps:
            if should_stop():
                return
            for names, changes in ((self.policies, {}), (self.baselines, _WITHOUT_OBSERVATIONS)):
                missing = {name: self._missing(rate, name) for name in names}
                most = max(map(len, missing.values()), default=0)
                if not most:
                    continue
                changes = {"frame_rate_hz": rate, "num_envs": min(num_envs, most), **changes}
                if pool is not None:
                    changes["num_envs"] = -(-changes["num_envs"] // pool.num_processes)
                    make = partial(make_env, **changes | {"num_workers": 0})
                    for name, episodes in missing.items():
                        driver = name if name in self.baselines else policy
                        greedy = name != "sampled"
                        found = pool.evaluate(
                            make, driver, episodes, greedy=greedy, should_stop=should_stop
                        )
                        yield from ((name, episode) for episode in found)
                    continue
                with closing(make_env(**changes)) as env:
                    for name, episodes in missing.items():
                        how: dict[str, Any] = {"greedy": name != "sampled", "on_frame": on_frame}
                        driver = BaselinePolicy(name, env) if name in self.baselines else policy
                        for episode in evaluate(env, driver, episodes, **how):
                            yield name, episode

    def _missing(self, rate: float, name: str) -> list[dict[str, Any]]:
        return [
            {"episode_seed": seed, "speed": speed}
            for speed in self.speeds
            for seed in self._seeds
            if seed not in self._found[speed, rate, name]
        ]

    def results(self) -> list[tuple[str, Episode]]:
        """Returns each episode with its policy's name, by speed, frame rate, policy and seed.

        Of an incomplete group, only the episodes before the first gap are returned: short episodes
        finish first, so taking all that are done would bias the result.
        """
        results = []
        for key in product(self.speeds, self.fps, [*self.policies, *self.baselines]):
            for seed in self._seeds:
                if seed not in self._found[key]:
                    break
                results.append((key[-1], self._found[key][seed]))
        return results

    def rows(self, **origin: Any) -> list[Row]:
        """Returns the rows of `results` for evaluation.csv, after the columns of their origin."""
        return [
            origin
            | {
                "policy": name,
                "speed": episode.speed,
                "fps": episode.fps,
                "episode_seed": episode.seed,
                "outcome": episode.outcome,
                "hit": episode.hit,
                "return": round(episode.total_reward, 4),
                "length": episode.length,
            }
            for name, episode in self.results()
        ]


def scene_id(scene: Scene) -> str:
    """Returns a short hash of all that a scene is: rows with the same one share a scene."""
    text = json.dumps(asdict(scene), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


_DRIVE = ("scene_id", "evaluation", "frames", "policy", "speed", "fps", "episode_seed", "outcome")


def save_drives(
    path: Path, rows: Sequence[Mapping[str, Any]], positions: Sequence[NDArray[np.float32]]
) -> None:
    """Adds where vehicles drove to a file, in place of the same episodes' earlier drives.

    The file holds `positions` [sum of T + 1, 2], x and y in metres; `starts` [N + 1], so that
    episode n is `positions[starts[n]:starts[n + 1]]`; and for each episode the columns of
    evaluation.csv that name it.

    Args:
        path: of the npz file.
        rows: of evaluation.csv.
        positions: for each row, `[T + 1, 2]`.
    """
    drives: dict[tuple[Any, ...], NDArray[np.float32]] = {}
    if path.is_file():
        with np.load(path, allow_pickle=False) as saved:
            names = zip(*(saved[column].tolist() for column in _DRIVE))
            drives = dict(zip(names, np.split(saved["positions"], saved["starts"][1:-1])))
    for row, driven in zip(rows, positions):
        name = tuple(row[column] for column in _DRIVE)
        drives[name] = driven
    arrays: dict[str, Any] = {
        column: np.array(values) for column, values in zip(_DRIVE, zip(*drives))
    }
    whole = path.with_suffix(".tmp.npz")
    np.savez_compressed(
        whole,
        positions=np.concatenate([*drives.values()]),
        starts=np.cumsum([0, *map(len, drives.values())]),
        **arrays,
    )
    whole.replace(path)


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


def cause_of(outcome: str, hit: str) -> str | None:
    """Returns why an episode failed, None if it did not.

    >>> cause_of("collision", "car"), cause_of("success", "")
    ('collision: other', None)
    """
    if outcome == "success":
        return None
    if outcome == "collision":
        return "collision: pedestrian" if hit == "pedestrian" else "collision: other"
    return outcome.replace("_", " ")


def failure_causes(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns the number of failures and their causes in % for each scene, policy and speed.

    Shares are of the failures, as in the paper's Table III, and empty where nothing failed.
    Evaluations after different numbers of training frames are kept apart.

    Args:
        rows: rows of evaluation.csv.
    """
    groups: dict[tuple[str, ...], list[str | None]] = defaultdict(list)
    for row in rows:
        key = tuple(str(row.get(name, "")) for name in _FAILURE_GROUP)
        groups[key].append(cause_of(row["outcome"], row.get("hit", "")))
    table = []
    for key, causes in groups.items():
        counts = Counter(cause for cause in causes if cause is not None)
        failures = counts.total()
        shares = {c: round(100 * counts[c] / failures, 1) if failures else "" for c in CAUSES}
        line = (
            dict(zip(_FAILURE_GROUP, key))
            | {"episodes": len(causes), "failures": failures}
            | shares
        )
        collisions = sum(counts[cause] for cause in CAUSES if cause.startswith("collision"))
        ratio = round(counts["out of bounds"] / collisions, 3) if collisions else ""
        table.append(line | {"out of bounds to collisions": ratio})
    return table


def print_failures(rows: Sequence[Mapping[str, Any]], console: Console | None = None) -> None:
    """Prints the causes of failure by policy and speed."""
    table = Table(title="Causes of failure in % of the failures", box=box.SIMPLE, pad_edge=False)
    for heading in ("speed", "fps", "policy", "failures"):
        table.add_column(heading, no_wrap=heading != "policy", overflow="fold")  # it may be a path
    lines = failure_causes(rows)
    for cause in CAUSES:
        # In two lines, so that all fit into 100 columns.
        heading = cause.replace(": ", ":\n").replace("of ", "of\n")
        table.add_column(heading, justify="right", no_wrap=True)
    for line in lines:
        shares = ["" if line[cause] == "" else f"{line[cause]:.0f}" for cause in CAUSES]
        failed = f"{line['failures']} of {line['episodes']}"
        rate = f"{float(line['fps']):g}"
        table.add_row(line["speed"], rate, line["policy"], failed, *shares)
    (console or Console(width=max(100, Console().width))).print(table)


def write_failures(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Writes the causes of failure as CSV, in place of an older table."""
    write_rows(path, failure_causes(rows))
