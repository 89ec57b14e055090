"""Streets that live through episodes one by one, each going on to the next once it is free."""

from collections.abc import Iterator, Sequence
from functools import cache, partial
from typing import Any

import gymnasium as gym
from gymnasium.vector.utils import create_empty_array

from flowrep.baselines.registry import BASELINES, Baseline, Drive, drive_episode
from flowrep.envs.sensor_observation import SensorObservation
from flowrep.envs.street_env import StreetEnv
from flowrep.envs.street_vector import StreetVectorEnv
from flowrep.envs.worker_process import Arrays, Order
from flowrep.envs.workers import WorkerVectorEnv
from flowrep.scenes.scene import Scene

Options = dict[str, Any]
"""What `StreetEnv.reset` takes to begin an episode: `episode_seed`, `speed`, `frame_rate_hz`."""


class EnvPool:
    """Streets of one scene, in this process or in others; an episode is the same in each of them.

    Args:
        scene: a loaded scene.
        sensors: what is observed, see `StreetEnv`; none where only baselines drive.
        num_envs: how many streets.
        num_workers: how many processes drive them; 0: this one.
        renderer: who draws, see `StreetEnv`.
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
        """Builds the streets."""
        street = partial(_street, scene, tuple(sensors), renderer)
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
        """Lets each street follow its order; see `StreetVectorEnv.advance`.

        Returns:
            What is seen, `[num_envs, ...]` by sensor, valid until the next call; how each episode
            stands.
        """
        if self._workers is not None:
            return self._workers.advance(orders)
        standings = self._streets.advance(orders, self._seen)
        return self._seen, standings

    def drive(self, jobs: Sequence[tuple[str, Options]]) -> Iterator[tuple[int, Drive]]:
        """Yields the drives of baselines, which see no picture, as they end.

        Args:
            jobs: a baseline's name and the episode for each; its number comes with the drive.
        """
        if self._workers is not None:
            yield from self._workers.apply(_drive, jobs)
        else:
            for number, job in enumerate(jobs):
                yield number, _drive(self._streets.envs[0], job)

    def close(self) -> None:
        """Ends the workers and gives the simulators back."""
        (self._workers or self._streets).close()


def _street(scene: Scene, sensors: tuple[str, ...], renderer: str) -> SensorObservation:
    return SensorObservation(StreetEnv(scene, sensors=sensors, renderer=renderer))


@cache
def _baseline(name: str) -> Baseline:
    """One of each in a process: the planner remembers the ways through a scene."""
    return BASELINES[name]()


def _drive(env: gym.Env, job: tuple[str, Options]) -> Drive:
    name, options = job
    street: Any = env.unwrapped
    return drive_episode(street, _baseline(name), options)
