"""Runs whole episodes of any policy, and makes tables of how they ended.

Training, `flowrep.evaluate`, films, `flowrep.view` and baselines all drive through `evaluate`.
"""

import hashlib
import json
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import product
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

from flowrep.baselines import BaselinePolicy
from flowrep.envs import Outcome
from flowrep.envs.episode import hit_name
from flowrep.progress import StopRequest, progress_bar
from flowrep.scenes import Scene

Policy = Callable[[TensorDictBase], TensorDictBase]
Row = dict[str, Any]

OUTCOMES = tuple(outcome.label for outcome in Outcome)
"""Names of the env's `outcome` codes; each one but the first ends an episode."""

CAUSES = ("out of bounds", "collision: pedestrian", "collision: other", "timeout")
_FAILURE_GROUP = (
    "scene", "scene_id", "representations", "flow", "frames", "evaluation", "policy", "speed", "fps"
)  # fmt: skip
_BLIND: dict[str, Any] = {"representations": {}, "noise": None, "num_workers": 0, "device": "cpu"}
"""The env of baselines, which read the simulator and need no observation."""
_DRAWS = 1  # separates a policy's draws from other draws of an episode's seed


@dataclass(frozen=True)
class Episode:
    """One finished episode."""

    seed: int  # identifies it, see `StreetEnv.reset`
    path: str  # the name of the scene's path that it was to follow
    speed: Any  # the pedestrians', as asked for; "" for the env's own
    fps: float
    outcome: str  # one of `OUTCOMES`
    hit: str  # the category that was hit, or ""
    total_reward: float  # undiscounted
    length: int  # the number of steps T
    # of the vehicle, x and y in metres, `[T + 1, 2]`
    positions: NDArray[np.float32] = field(repr=False, compare=False)

    def row(self) -> Row:
        """Returns its columns in evaluation.csv."""
        return {
            "speed": self.speed,
            "fps": self.fps,
            "episode_seed": self.seed,
            "path": self.path,
            "outcome": self.outcome,
            "hit": self.hit,
            "return": round(self.total_reward, 4),
            "length": self.length,
        }


class _Running:
    """An episode that a place of the env's batch is driving."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        self.options = dict(options)
        self.rng = np.random.default_rng((options["episode_seed"], _DRAWS))
        self.positions: list[list[float]] = []
        self.total_reward = 0.0


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: Policy | str,
    episodes: Iterable[Mapping[str, Any]],
    *,
    greedy: bool = True,
    on_frame: Callable[[TensorDictBase], Any] | None = None,
    stop: StopRequest | None = None,
) -> Iterator[Episode]:
    """Yields finished episodes, in the order in which they end.

    Each place of the env's batch drives one episode after the other; one that finds none left is
    idle. The policy sees the busy places alone, with two more keys for those that remember:
    `env_id` int64 `[N]`, the place, and `is_init` bool `[N, 1]`, whether its episode just began.

    Args:
        env: made by `make_env`; without workers for a baseline.
        policy: writes `action` `[N]`, and has `get_dist` if it isn't greedy; or a baseline's name.
        episodes: options of `StreetEnv.reset`, `episode_seed` among them.
        greedy: whether the likeliest action is taken, or one is drawn.
        on_frame: called with the env's TensorDict after each reset and each step.
        stop: ends the evaluation between two steps.
    """
    if isinstance(policy, str):
        policy = BaselinePolicy(policy, env)
    waiting = deque(episodes)
    paths = [path.name for path in env.base_env.scene.paths]
    running: dict[int, _Running] = {}  # by place
    tensordict: TensorDictBase | None = None
    free = list(range(env.batch_size[0]))
    while not stop:
        if free:
            begun = {place: _Running(waiting.popleft()) for place in free if waiting}
            running |= begun
            if not running:
                return
            tensordict = _reset(env, tensordict, free, running)
            vehicles = tensordict["vehicle"].tolist()
            for place, episode in begun.items():
                episode.positions.append(vehicles[place][:2])
            if on_frame is not None:
                on_frame(tensordict)
        assert tensordict is not None
        busy = sorted(running)
        tensordict["action"] = _act(policy, tensordict, busy, running, greedy)
        tensordict = env.step(tensordict)["next"]
        if on_frame is not None:
            on_frame(tensordict)
        status = {
            key: tensordict[key].tolist()
            for key in ("vehicle", "reward", "outcome", "hit", "path", "episode_seed")
        }
        free = [place for place in busy if status["outcome"][place][0]]
        for place in busy:
            running[place].positions.append(status["vehicle"][place][:2])
            running[place].total_reward += status["reward"][place][0]
        for place in free:
            ended = running.pop(place)
            yield Episode(
                seed=status["episode_seed"][place][0],
                path=paths[status["path"][place][0]],
                speed=ended.options.get("speed", ""),
                fps=env.base_env.frame_rate_hz,
                outcome=OUTCOMES[status["outcome"][place][0]],
                hit=hit_name(status["hit"][place][0]),
                total_reward=ended.total_reward,
                length=len(ended.positions) - 1,
                positions=np.array(ended.positions, dtype=np.float32),
            )


def _reset(
    env: EnvBase,
    tensordict: TensorDictBase | None,
    free: Sequence[int],
    running: Mapping[int, _Running],
) -> TensorDictBase:
    """Begins the episodes of places whose last one has ended."""
    places = range(env.batch_size[0])
    options = {"episodes": [running[i].options if i in running else None for i in places]}
    if tensordict is None:
        return env.reset(options=options)
    mask = torch.zeros(*env.batch_size, 1, dtype=torch.bool, device=env.device)
    mask[free] = True
    return env.reset(tensordict.set("_reset", mask), options=options)


def _act(
    policy: Any,
    tensordict: TensorDictBase,
    busy: list[int],
    running: Mapping[int, _Running],
    greedy: bool,
) -> torch.Tensor:
    """Returns actions `[num_envs]`, chosen by the policy for the busy places."""
    device = tensordict.device
    seen = tensordict.copy() if len(busy) == len(tensordict) else tensordict[busy]
    seen["env_id"] = torch.tensor(busy, device=device)
    seen["is_init"] = torch.tensor([[len(running[i].positions) == 1] for i in busy], device=device)
    actions = torch.zeros(len(tensordict), dtype=torch.int64, device=device)
    if greedy:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            actions[busy] = policy(seen)["action"].to(device)
    else:
        shares = policy.get_dist(seen).probs.double().cumsum(-1).cpu().numpy()
        # from the episode's own generator, so that it repeats whatever else is in the batch
        drawn = np.array([running[i].rng.random() for i in busy])[:, None]
        # the least action whose cumulated share exceeds the draw; the last share is 1 but for
        # rounding
        chosen = (drawn * shares[:, -1:] >= shares[:, :-1]).sum(axis=-1)
        actions[busy] = torch.as_tensor(chosen, device=device)
    return actions


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Returns Wilson's score interval of a proportion; (0, 1) without trials."""
    if not trials:
        return 0.0, 1.0
    # the shares p from which the one found is at most z standard errors away: the solutions of
    # (share - p)² = z² p (1 - p) / trials
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


@dataclass
class Comparison:
    """The same episodes for an agent and baselines: which to run, and the results so far.

    Episode k of each policy, speed and frame rate has the seed `seed + k`.
    """

    speeds: Sequence[str]
    fps: Sequence[float]
    episodes: int  # for each policy, speed and frame rate
    seed: int
    # "greedy", "sampled" or both; or the name of a policy with only one way to act
    policies: Sequence[str] = ("greedy",)
    baselines: Sequence[str] = ()

    def __post_init__(self) -> None:
        self._seeds = range(self.seed, self.seed + self.episodes)
        self._found: dict[tuple[str, float, str], dict[int, Episode]] = {
            key: {} for key in product(self.speeds, self.fps, [*self.policies, *self.baselines])
        }

    @property
    def total(self) -> int:
        """The number of episodes to run."""
        return len(self._found) * len(self._seeds)

    @property
    def done(self) -> int:
        """The number of episodes that have been run."""
        return sum(map(len, self._found.values()))

    def run(
        self,
        make_env: Callable[..., EnvBase],
        policy: Policy | str,
        num_envs: int,
        *,
        stop: StopRequest | None = None,
        save: Callable[[], Any] = lambda: None,
    ) -> None:
        """Runs the episodes; finished ones are kept even if it is interrupted.

        A second run, of another agent in the same scene, keeps the baselines' episodes. `save` is
        called when all of a policy at one speed and frame rate have been run.
        """
        for (_, _, name), episodes in self._found.items():
            if name in self.policies:
                episodes.clear()
        with progress_bar(
            what="evaluating", desc="evaluating", total=self.total, initial=self.done,
            unit="episode", leave=False, miniters=0, mininterval=0.5,
        ) as bar:  # fmt: skip
            # the bar's clock goes on: the first episodes take seconds
            for name, episode in self._episodes(
                make_env, policy, num_envs, stop, on_frame=lambda _: bar.update(0)
            ):
                found = self._found[episode.speed, episode.fps, name]
                found[episode.seed] = episode
                bar.update()
                if len(found) == len(self._seeds):
                    save()

    def _episodes(
        self,
        make_env: Callable[..., EnvBase],
        policy: Policy | str,
        num_envs: int,
        stop: StopRequest | None,
        on_frame: Callable[[TensorDictBase], Any],
    ) -> Iterator[tuple[str, Episode]]:
        """Yields the missing episodes, each with its policy's name."""
        for rate in self.fps:
            for names, changes in ((self.policies, {}), (self.baselines, _BLIND)):
                jobs = {name: self._job(name, policy, rate) for name in names}
                most = max((len(job["episodes"]) for job in jobs.values()), default=0)
                if stop or not most:
                    continue
                make = partial(make_env, **changes, frame_rate_hz=rate)
                with closing(make(num_envs=min(num_envs, most))) as env:
                    for name, job in jobs.items():
                        for episode in evaluate(env, **job, on_frame=on_frame, stop=stop):
                            yield name, episode

    def _job(self, name: str, policy: Policy | str, rate: float) -> dict[str, Any]:
        """Returns the arguments of `evaluate` for a policy's missing episodes at a frame rate."""
        missing = [
            {"episode_seed": seed, "speed": speed}
            for speed in self.speeds
            for seed in self._seeds
            if seed not in self._found[speed, rate, name]
        ]
        driver = name if name in self.baselines else policy
        return {"policy": driver, "episodes": missing, "greedy": name != "sampled"}

    def results(self, *, only_whole: bool = False) -> list[tuple[str, Episode]]:
        """Returns each ended episode with its policy's name.

        They are in the order of speed, frame rate, policy and seed. Of an evaluation that was
        interrupted, shares are not to be taken of a policy at a speed and a frame rate that lacks
        episodes: short ones end first. `only_whole` leaves those out.
        """
        return [
            (name, found[seed])
            for (_, _, name), found in self._found.items()
            if not only_whole or len(found) == len(self._seeds)
            for seed in self._seeds
            if seed in found
        ]

    def rows(self, *, only_whole: bool = False, **origin: Any) -> list[Row]:
        """Returns the rows of `results` for evaluation.csv, after the columns of their origin."""
        results = self.results(only_whole=only_whole)
        return [{**origin, "policy": name, **episode.row()} for name, episode in results]


def scene_id(scene: Scene) -> str:
    """Returns a short hash of all that a scene is: rows with the same one share a scene."""
    text = json.dumps(asdict(scene), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def failure_causes(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns the number of failures and their causes in % for each scene, policy and speed.

    Shares are of the failures, as in the paper's Table III, and empty where nothing failed.
    Evaluations after different numbers of training frames are kept apart.
    """
    groups: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for row in rows:
        key = tuple(str(row.get(name, "")) for name in _FAILURE_GROUP)
        cause = row["outcome"].replace("_", " ")
        if cause == "collision":
            cause += ": pedestrian" if row.get("hit") == "pedestrian" else ": other"
        groups[key].append(cause)
    table = []
    for key, causes in groups.items():
        counts = Counter(causes)
        failures = len(causes) - counts["success"]
        shares = {c: round(100 * counts[c] / failures, 1) if failures else "" for c in CAUSES}
        collisions = counts["collision: pedestrian"] + counts["collision: other"]
        ratio = round(counts["out of bounds"] / collisions, 3) if collisions else ""
        table.append(
            {
                **dict(zip(_FAILURE_GROUP, key)),
                "episodes": len(causes),
                "failures": failures,
                **shares,
                "out of bounds to collisions": ratio,
            }
        )
    return table


def print_results(rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints the share of each outcome, and the causes of failure, by policy and speed."""
    by_policy: dict[tuple[Any, ...], list[str]] = defaultdict(list)
    for row in rows:
        by_policy[row["speed"], f"{float(row['fps']):g}", row["policy"]].append(row["outcome"])
    table = [
        {"speed": speed, "fps": fps, "policy": policy, "episodes": len(outcomes)}
        | {
            name: f"{100 * share:.0f} [{100 * low:.0f}–{100 * high:.0f}]"
            for name, (share, low, high) in outcome_shares(outcomes).items()
        }
        for (speed, fps, policy), outcomes in by_policy.items()
    ]
    print_table("Share of episodes in % [95 % interval]", table)
    table = [
        {"speed": line["speed"], "fps": f"{float(line['fps']):g}", "policy": line["policy"]}
        | {"failures": f"{line['failures']} of {line['episodes']}"}
        | {cause: "" if line[cause] == "" else f"{line[cause]:.0f}" for cause in CAUSES}
        for line in failure_causes(rows)
    ]
    print_table("Causes of failure in % of the failures", table)


def print_table(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints rows that have the same keys, which are the headings."""
    table = Table(title=title, box=box.SIMPLE, pad_edge=False)
    for name in rows[0]:
        heading = name.replace("_", " ").replace(": ", ":\n")
        is_number = all(str(row[name])[:1] in "-0123456789" for row in rows)
        # a policy's name may be a long path
        table.add_column(
            heading,
            no_wrap=name != "policy",
            overflow="fold",
            justify="right" if is_number else "left",
        )
    for row in rows:
        table.add_row(*map(str, row.values()))
    # names are text: a[b] is no markup, :car: no emoji
    console = Console(width=max(100, Console().width), markup=False, emoji=False)
    console.print(table)
