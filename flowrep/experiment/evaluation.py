"""Runs whole episodes of any policy; `run.RunFolder` writes their records.

Training, `flowrep.evaluate`, films, `flowrep.view` and baselines all drive through `evaluate`.
"""

import hashlib
import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flowrep.baselines import BaselinePolicy
from flowrep.envs import Outcome
from flowrep.envs.street_env import hit_name
from flowrep.experiment import build
from flowrep.experiment.outcomes import EpisodeRecord
from flowrep.experiment.schema import EnvConfig
from flowrep.progress import StopRequest, progress_bar
from flowrep.scenes import Scene

Policy = Callable[[TensorDictBase], TensorDictBase]

FIRST_SEEDS = {"training": 1_000_000, "final": 1_500_000, "evaluate": 2_000_000}
"""The seed of the first episode of each kind of evaluation, far enough apart that none overlap.

The keys are the values of the column `evaluation`; conf/evaluate.yaml has the last seed, too.
Training draws its episodes from 2³¹ seeds.
"""
EVALUATION_ENVS = 192  # side by side: more make a step of each cheaper

_DRAWS = 1  # separates a policy's draws from other draws that use the episode's seed


@dataclass(frozen=True)
class Driver:
    """A policy and the config of the env in which it acts."""

    policy: Policy  # writes `action`
    config: EnvConfig
    frames: int = 0  # frames of its training; 0 if unknown
    trained_in: Scene | None = None  # None if unknown

    def make_env(self, **changes: Any) -> EnvBase:
        """Returns the config's env; `changes` replace arguments of `flowrep.envs.make_env`."""
        num_envs = changes.get("num_envs", self.config.num_envs)
        workers = {"num_workers": build.evaluation_workers(self.config, num_envs)}
        return build.env(self.config, **workers | changes)

    def origin(self, evaluation: str) -> dict[str, Any]:
        """Returns the fields of an `EpisodeRecord` that describe the agent and the scene."""
        scene = self.config.scene
        return {
            "scene": scene.name,
            "scene_id": scene_id(scene),
            "representations": "+".join(self.config.representations),
            "flow": self.config.flow.source,
            # Without a training, the config's seed is the default of conf/ and says nothing.
            "seed": self.config.seed if self.frames else "",
            "frames": self.frames,
            "evaluation": evaluation,
        }


class _Running:
    """An episode that one env of the batch is driving."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        self.options = dict(options)
        self.rng = np.random.default_rng((options["episode_seed"], _DRAWS))
        self.positions: list[list[float]] = []
        self.return_ = 0.0


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: Policy,
    episodes: Iterable[Mapping[str, Any]],
    *,
    greedy: bool = True,
    on_frame: Callable[[TensorDictBase], Any] = lambda tensordict: None,
    stop: StopRequest | None = None,
) -> Iterator[EpisodeRecord]:
    """Yields the records of episodes, in the order in which they end.

    Each env of the batch runs episodes back to back and idles when none remain. The policy gets
    only the busy envs, with two more keys for policies with a memory: `env_id` int64 `[N]`, the
    env's index, and `is_init` bool `[N, 1]`, whether its episode just began.

    Args:
        env: made by `make_env`; without workers for a baseline.
        policy: writes `action` `[N]`, and has `get_dist` if it isn't greedy.
        episodes: options of `StreetEnv.reset`, `episode_seed` among them.
        greedy: whether the likeliest action is taken, or one is drawn.
        on_frame: called with the TensorDict of each step, and of each end, which has no `action`.
        stop: ends the evaluation between two steps.
    """
    if isinstance(policy, BaselinePolicy):
        policy.enter(env)
    waiting = deque(episodes)
    paths = [path.name for path in env.base_env.scene.paths]
    running: dict[int, _Running] = {}  # by the env's index
    tensordict: TensorDictBase | None = None
    free = list(range(env.batch_size[0]))
    while not stop:
        if free:
            begun = {i: _Running(waiting.popleft()) for i in free if waiting}
            running |= begun
            if not running:
                return
            tensordict = _reset(env, tensordict, free, running)
            vehicles = tensordict["vehicle"].tolist()
            for i, episode in begun.items():
                episode.positions.append(vehicles[i][:2])
        assert tensordict is not None
        busy = sorted(running)
        tensordict["action"] = _act(policy, tensordict, busy, running, greedy)
        on_frame(tensordict)
        tensordict = env.step(tensordict)["next"]
        status = {
            key: tensordict[key].tolist()
            for key in ("vehicle", "reward", "outcome", "hit", "path", "episode_seed")
        }
        # `tolist` above copies each key once; reading env by env would wait for a GPU each time.
        free = [i for i in busy if status["outcome"][i][0]]
        if free:
            on_frame(tensordict)
        for i in busy:
            running[i].positions.append(status["vehicle"][i][:2])
            running[i].return_ += status["reward"][i][0]
        for i in free:
            ended = running.pop(i)
            yield EpisodeRecord(
                speed=ended.options.get("speed", ""),
                fps=env.base_env.frame_rate_hz,
                episode_seed=status["episode_seed"][i][0],
                path=paths[status["path"][i][0]],
                outcome=Outcome(status["outcome"][i][0]).label,
                hit=hit_name(status["hit"][i][0]),
                return_=ended.return_,
                length=len(ended.positions) - 1,
                positions=np.array(ended.positions, dtype=np.float32),
            )


def _reset(
    env: EnvBase,
    tensordict: TensorDictBase | None,
    free: Sequence[int],
    running: Mapping[int, _Running],
) -> TensorDictBase:
    """Begins the next episodes of the envs whose last one has ended."""
    indices = range(env.batch_size[0])
    options = {"episodes": [running[i].options if i in running else None for i in indices]}
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
    """Returns actions `[num_envs]`, chosen by the policy for the busy envs."""
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
        # Drawn by the episode's generator, so that an episode doesn't depend on the rest of the
        # batch.
        drawn = np.array([running[i].rng.random() for i in busy])[:, None]
        # The first action whose cumulative share exceeds the draw, which is scaled by the last
        # share: that is 1 only up to rounding.
        chosen = (drawn * shares[:, -1:] >= shares[:, :-1]).sum(axis=-1)
        actions[busy] = torch.as_tensor(chosen, device=device)
    return actions


@dataclass
class PairedEvaluation:
    """The same episodes for an agent and baselines: which to run, and the records so far.

    Episode k of each policy, speed and frame rate has the seed `seed + k`. A policy at one speed
    and frame rate is a group. Only whole groups count: short episodes end first, so the ones that
    ended before a stop are a biased sample.
    """

    speeds: Sequence[str]
    fps: Sequence[float]
    episodes: int  # of each group
    seed: int
    # "greedy", "sampled" or both; or the name of a policy that can't do both
    policies: Sequence[str] = ("greedy",)
    baselines: Sequence[str] = ()

    def __post_init__(self) -> None:
        self._seeds = range(self.seed, self.seed + self.episodes)
        self._groups: dict[tuple[str, float, str], dict[int, EpisodeRecord]] = {
            key: {} for key in product(self.speeds, self.fps, [*self.policies, *self.baselines])
        }

    @property
    def total(self) -> int:
        """The number of episodes to run."""
        return len(self._groups) * len(self._seeds)

    @property
    def done(self) -> int:
        """The number of episodes that have been run."""
        return sum(map(len, self._groups.values()))

    def run(
        self,
        make_env: Callable[..., EnvBase],
        policy: Policy,
        num_envs: int,
        *,
        stop: StopRequest | None = None,
        save: Callable[[], Any] = lambda: None,
    ) -> None:
        """Runs the episodes, until all are done or a stop is requested.

        A second run, of another agent in the same scene, keeps the baselines' episodes. `save` is
        called after each group.
        """
        for (_, _, name), group in self._groups.items():
            if name in self.policies:
                group.clear()
        with progress_bar(
            what="evaluating", total=self.total, initial=self.done, unit="episode", leave=False,
            miniters=0, mininterval=0.5,
        ) as bar:  # fmt: skip
            # Each frame redraws the bar's clock, since the first episodes take seconds.
            for episode in self._episodes(
                make_env, policy, num_envs, stop, on_frame=lambda _: bar.update(0)
            ):
                group = self._groups[episode.speed, episode.fps, episode.policy]
                group[episode.episode_seed] = episode
                bar.update()
                if len(group) == len(self._seeds):
                    save()

    def _episodes(
        self,
        make_env: Callable[..., EnvBase],
        policy: Policy,
        num_envs: int,
        stop: StopRequest | None,
        on_frame: Callable[[TensorDictBase], Any],
    ) -> Iterator[EpisodeRecord]:
        """Yields the missing episodes."""
        # An env has one frame rate; its pedestrians' speed changes from episode to episode.
        for rate in self.fps:
            for names, changes in ((self.policies, {}), (self.baselines, BaselinePolicy.ENV)):
                jobs = {name: self._job(name, policy, rate) for name in names}
                most = max((len(job["episodes"]) for job in jobs.values()), default=0)
                if stop or not most:
                    continue
                make = partial(make_env, **changes, frame_rate_hz=rate)
                with closing(make(num_envs=min(num_envs, most))) as env:
                    for name, job in jobs.items():
                        for episode in evaluate(env, **job, on_frame=on_frame, stop=stop):
                            yield replace(episode, policy=name)

    def _job(self, name: str, policy: Policy, rate: float) -> dict[str, Any]:
        """Returns the arguments of `evaluate` for a policy's missing episodes at a frame rate."""
        missing = [
            {"episode_seed": seed, "speed": speed}
            for speed in self.speeds
            for seed in self._seeds
            if seed not in self._groups[speed, rate, name]
        ]
        driver = BaselinePolicy(name) if name in self.baselines else policy
        return {"policy": driver, "episodes": missing, "greedy": name != "sampled"}

    def records(self, **origin: Any) -> list[EpisodeRecord]:
        """Returns the episodes of whole groups, by speed, frame rate, policy and seed.

        `origin` are the fields that describe the agent, see `Driver.origin`.
        """
        whole = [group for group in self._groups.values() if len(group) == len(self._seeds)]
        return [replace(group[seed], **origin) for group in whole for seed in self._seeds]


def scene_id(scene: Scene) -> str:
    """Returns a short hash of all that defines a scene."""
    data = asdict(scene)
    if scene.pedestrian_size == 1.0:  # the key is younger than the ids in stored tables
        del data["pedestrian_size"]
    text = json.dumps(data, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]
