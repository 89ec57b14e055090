"""Drivers that learn nothing, which any agent is measured beside."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowrep.drivers.planner import Planner
from flowrep.envs.outcome import Outcome, reward
from flowrep.envs.street_env import StreetEnv
from flowrep.scenes.vehicle import NO_OP

Driver = Callable[[StreetEnv], int]


def never_turn(env: StreetEnv) -> int:
    """Returns NO_OP: drives on as at the start."""
    return NO_OP


class RandomDriver:
    """Returns actions drawn evenly; in an episode always the same, whichever came before."""

    def __init__(self, seed: int = 0) -> None:
        """Takes the seed that sets it apart from other random drivers."""
        self._seed = seed
        self._rng = np.random.default_rng(seed)

    def __call__(self, env: StreetEnv) -> int:
        """Returns one of the three actions."""
        if not env.episode.steps:
            self._rng = np.random.default_rng((env.episode.seed, self._seed))
        return int(self._rng.integers(3))


@dataclass(frozen=True)
class Drive:
    """One finished episode: which one, how it ended, what was hit, its return and its steps."""

    episode_seed: int
    outcome: str
    hit: str
    total_reward: float
    steps: int


def drive_episode(env: StreetEnv, driver: Driver, options: dict[str, Any]) -> Drive:
    """Returns an episode, driven to its end without anything being looked at.

    Args:
        env: the street.
        driver: chooses the actions.
        options: of `StreetEnv.reset`, which name the episode.
    """
    env.begin(options=options)
    return _drive_on(env, driver)


def drives(
    env: StreetEnv, driver: Driver, episodes: int, *, seed: int | None = None
) -> Iterator[Drive]:
    """Yields finished episodes, the same ones for every driver; `seed` None goes on in the env's.

    Nothing is looked at.

    >>> env = StreetEnv("straight_road", sensors=())
    >>> [drive.outcome in ("success", "collision") for drive in drives(env, never_turn, 2, seed=0)]
    [True, True]
    """
    for number in range(episodes):
        env.begin(seed=seed if number == 0 else None)
        yield _drive_on(env, driver)


def _drive_on(env: StreetEnv, driver: Driver) -> Drive:
    total, outcome = 0.0, Outcome.RUNNING
    while not outcome:
        outcome = env.drive(driver(env))
        total += reward(outcome)
    episode = env.episode
    return Drive(episode.seed, outcome.label, episode.hit, total, episode.steps)


BASELINES: dict[str, Callable[[], Driver]] = {
    "planner": Planner,
    "never_turn": lambda: never_turn,
    "random": RandomDriver,
}
