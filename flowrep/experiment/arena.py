"""Runs episodes of agents in a pool of environments, all of them busy until the last jobs."""

from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flowrep.baselines.baselines import Drive
from flowrep.envs.episode import Outcome, reward
from flowrep.envs.workers import Order
from flowrep.experiment.env_pool import EnvPool, Options
from flowrep.experiment.evaluation import Episode
from flowrep.experiment.eye import Eye
from flowrep.scenes.scene import Scene

_REWARD = {outcome.label: reward(outcome) for outcome in Outcome}
_RUNNING = Outcome.RUNNING.label
_DRAWS = 1  # separates an agent's draws from other draws of an episode's seed


class Agent(NamedTuple):
    """A policy and its observations."""

    policy: Any
    representations: Mapping[str, Any]
    flow: str | Mapping[str, Any] = "exact"
    noise: Mapping[str, float] | None = None
    device: torch.device | str = "cpu"

    @classmethod
    def from_config(cls, policy: Any, config: Any, device: torch.device) -> "Agent":
        """Returns a policy with the observations of a run's config."""
        flow, noise = config.flow.plain(), config.noise.plain()
        return cls(policy, config.representations, flow, noise, device)

    def eye(self, scene: Scene, frame_rate_hz: float) -> Eye:
        """Returns the `Eye` that computes its observations in a scene."""
        return Eye(
            scene,
            self.representations,
            frame_rate_hz,
            flow=self.flow,
            noise=self.noise,
            device=self.device,
        )


class Job(NamedTuple):
    """One episode for an agent to drive."""

    agent: int
    is_greedy: bool
    speed: str
    fps: float
    episode_seed: int


@dataclass
class _Ride:
    """A job that an environment is running."""

    number: int
    job: Job
    rng: np.random.Generator
    total_reward: float = 0.0
    length: int = 0


class Arena:
    """Agents and the environments of one scene.

    Args:
        scene: a loaded scene.
        agents: the agents that will drive.
        make_pool: called with the scene and the sensors that the agents need.
    """

    def __init__(
        self,
        scene: Scene,
        agents: Sequence[Agent],
        make_pool: Callable[[Scene, Sequence[str]], EnvPool],
    ) -> None:
        """Makes the pool."""
        self.agents = list(agents)
        self._scene = scene
        self._eyes: dict[tuple[int, float], Eye] = {}  # by agent and frame rate
        any_rate = scene.frame_rate_hz
        sensors = {name for agent in agents for name in agent.eye(scene, any_rate).sensors}
        self._pool = make_pool(scene, sorted(sensors))

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[int, Episode]]:
        """Yields the jobs' episodes with their numbers, as they end.

        An episode depends on its job alone, not on the number of environments or their other
        episodes. A free environment takes the next job, in the order of `jobs`; environments that
        share an agent and a frame rate are computed together.
        """
        waiting = deque(enumerate(jobs))
        rides: list[_Ride | None] = [None] * self._pool.num_envs
        actions: dict[int, int] = {}
        while True:
            orders: list[Order] = [None] * len(rides)
            for street, ride in enumerate(rides):
                if ride is not None:
                    orders[street] = actions[street]
                elif waiting:
                    number, job = waiting.popleft()
                    rng = np.random.default_rng((job.episode_seed, _DRAWS))
                    rides[street] = _Ride(number, job, rng)
                    orders[street] = {
                        "episode_seed": job.episode_seed,
                        "speed": job.speed,
                        "frame_rate_hz": job.fps,
                    }
            if all(order is None for order in orders):
                return
            seen, standings = self._pool.advance(orders)
            begun = {street for street, order in enumerate(orders) if isinstance(order, dict)}
            for street, (ride, standing) in enumerate(zip(rides, standings)):
                if ride is None or standing is None or street in begun:
                    continue
                outcome, hit = standing
                ride.total_reward += _REWARD[outcome]
                ride.length += 1
                if outcome != _RUNNING:
                    seed = ride.job.episode_seed
                    yield ride.number, Episode(seed, outcome, hit, ride.total_reward, ride.length)
                    rides[street] = None
            actions = self._act(seen, rides, begun)

    def drive(self, jobs: Sequence[tuple[str, Options]]) -> Iterator[tuple[int, Drive]]:
        """Yields the episodes of baselines, see `EnvPool.drive`."""
        return self._pool.drive(jobs)

    def close(self) -> None:
        """Closes the environments."""
        self._pool.close()

    @torch.no_grad()
    def _act(
        self, seen: Mapping[str, Any], rides: Sequence[_Ride | None], begun: set[int]
    ) -> dict[int, int]:
        """Returns an action for each environment that is running a job."""
        groups: dict[tuple[int, float], list[int]] = defaultdict(list)
        for street, ride in enumerate(rides):
            if ride is not None:
                groups[ride.job.agent, ride.job.fps].append(street)
        actions: dict[int, int] = {}
        for (agent, rate), streets in groups.items():
            first = [street for street in streets if street in begun]
            later = [street for street in streets if street not in begun]
            maps = self._eye(agent, rate).look(seen, first, later)
            order = [*first, *later]
            # for policies that remember what they saw in an environment
            maps["street"] = torch.tensor(order, device=maps.device)
            maps["is_init"] = (torch.arange(len(order)) < len(first)).unsqueeze(-1)
            policy = self.agents[agent].policy
            for is_greedy, choose in ((True, _likeliest), (False, _drawn)):
                rows = [i for i, s in enumerate(order) if _job(rides, s).is_greedy is is_greedy]
                if rows:
                    part = maps if len(rows) == len(order) else maps[rows]
                    chosen = choose(policy, part, [rides[order[row]] for row in rows])
                    actions |= zip((order[row] for row in rows), chosen)
        return actions

    def _eye(self, agent: int, frame_rate_hz: float) -> Eye:
        key = agent, frame_rate_hz
        if key not in self._eyes:
            self._eyes[key] = self.agents[agent].eye(self._scene, frame_rate_hz)
        return self._eyes[key]


def _job(rides: Sequence[_Ride | None], street: int) -> Job:
    ride = rides[street]
    assert ride is not None
    return ride.job


def _likeliest(policy: Any, maps: TensorDictBase, rides: Sequence[Any]) -> list[int]:
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(maps)["action"].tolist()


def _drawn(policy: Any, maps: TensorDictBase, rides: Sequence[Any]) -> list[int]:
    """Draws each action from its episode's own generator, whatever else is in the batch."""
    shares = policy.get_dist(maps).probs.double().cumsum(-1).cpu().numpy()
    drawn = np.array([ride.rng.random() for ride in rides])[:, None]
    return (drawn * shares[:, -1:] >= shares[:, :-1]).sum(axis=-1).tolist()
