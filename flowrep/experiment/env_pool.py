"""A pool of environments that run episodes one after another."""

from collections.abc import Iterator, Sequence
from functools import cache, partial
from typing import Any

import gymnasium as gym
from gymnasium.vector.utils import create_empty_array

from flowrep.baselines.baselines import BASELINES, Baseline, Drive, drive_episode
from flowrep.envs.street_env import StreetEnv
from flowrep.envs.vector_env import StreetVectorEnv, sensed
from flowrep.envs.workers import Arrays, Order, WorkerVectorEnv
from flowrep.scenes.scene import Scene

Options = dict[str, Any]
"""What `StreetEnv.reset` takes to begin an episode: `episode_seed`, `speed`, `frame_rate_hz`."""


class EnvPool:
    """Environments of one scene, in this process or in workers; an episode is the same in each.

    Args:
        scene: a loaded scene.
        sensors: the observed sensors, see `StreetEnv`; none if only baselines drive.
        num_envs: the number of environments.
        num_workers: the number of processes that step them; 0 steps them in this one.
        renderer: see `StreetEnv`.
    """

    def __init__(
        self,
        scene: Scene,
        sensors: Sequence[str],
        *,
        num_envs: int,
        num_workers: int = 0,
        renderer: str = "auto",
    ) -> None:
        """Makes the environments."""
        bare = partial(StreetEnv, scene, renderer=renderer)
        street = partial(sensed, bare, tuple(sensors))
        self.num_envs = num_envs
        self._workers: WorkerVectorEnv | None = None
        if num_workers:
            factories = [street] * num_envs
            self._workers = WorkerVectorEnv(factories, num_workers, in_each=StreetVectorEnv)
        else:
            self._streets = StreetVectorEnv([street] * num_envs)
            space: Any = self._streets.single_observation_space
            empty: Any = create_empty_array(space, num_envs)
            self._seen: Arrays = empty.get("sensor", {})

    def advance(self, orders: Sequence[Order]) -> tuple[Arrays, list[tuple[str, str] | None]]:
        """Executes one order per environment; see `StreetVectorEnv.advance`.

        Returns:
            The sensor maps `[num_envs, ...]`, valid until the next call; the status of each
            episode.
        """
        if self._workers is not None:
            return self._workers.advance(orders)
        standings = self._streets.advance(orders, self._seen)
        return self._seen, standings

    def drive(self, jobs: Sequence[tuple[str, Options]]) -> Iterator[tuple[int, Drive]]:
        """Yields the episodes of baselines, which need no rendering, as they end.

        Args:
            jobs: a baseline's name and an episode each; a drive is yielded with its job's index.
        """
        if self._workers is not None:
            yield from self._workers.apply(_drive, jobs)
        else:
            for number, job in enumerate(jobs):
                yield number, _drive(self._streets.envs[0], job)

    def close(self) -> None:
        """Stops the workers and closes the simulators."""
        (self._workers or self._streets).close()


@cache
def _baseline(name: str) -> Baseline:
    """Returns a baseline, one per process: the planner remembers the ways through a scene."""
    return BASELINES[name]()


def _drive(env: gym.Env, job: tuple[str, Options]) -> Drive:
    name, options = job
    street: Any = env.unwrapped
    return drive_episode(street, _baseline(name), options)
