"""Baselines to compare an agent with: policies without learning that may read the env's state."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowrep.baselines.planner import Planner
from flowrep.envs.episode import Outcome, reward
from flowrep.envs.street_env import StreetEnv
from flowrep.scenes.scene import NO_OP

Baseline = Callable[[StreetEnv], int]
"""Returns the next action; may read the env's whole state."""


def never_turn(env: StreetEnv) -> int:
    """Returns NO_OP: drives straight on."""
    return NO_OP


class RandomActions:
    """Draws actions uniformly; those of an episode don't depend on earlier episodes."""

    def __init__(self, seed: int = 0) -> None:
        """Takes a seed; other seeds give other actions."""
        self._seed = seed
        self._rng = np.random.default_rng(seed)

    def __call__(self, env: StreetEnv) -> int:
        """Returns one of the three actions."""
        if not env.episode.steps:
            self._rng = np.random.default_rng((env.episode.seed, self._seed))
        return int(self._rng.integers(3))


@dataclass(frozen=True)
class Drive:
    """A finished episode: its seed, outcome, category hit, return and number of steps."""

    episode_seed: int
    outcome: str
    hit: str
    total_reward: float
    steps: int


def drive_episode(env: StreetEnv, baseline: Baseline, options: dict[str, Any]) -> Drive:
    """Drives one episode to its end without rendering, and returns it.

    Args:
        env: the environment.
        baseline: chooses the actions.
        options: passed to `StreetEnv.reset`; they select the episode.
    """
    env.begin(options=options)
    return _drive_on(env, baseline)


def drives(
    env: StreetEnv, baseline: Baseline, episodes: int, *, seed: int | None = None
) -> Iterator[Drive]:
    """Yields finished episodes, the same for every baseline, without rendering.

    If `seed` is None, the env continues its own sequence of episodes.

    >>> env = StreetEnv("straight_road", sensors=())
    >>> [drive.outcome in ("success", "collision") for drive in drives(env, never_turn, 2, seed=0)]
    [True, True]
    """
    for number in range(episodes):
        env.begin(seed=seed if number == 0 else None)
        yield _drive_on(env, baseline)


def _drive_on(env: StreetEnv, baseline: Baseline) -> Drive:
    total, outcome = 0.0, Outcome.RUNNING
    while not outcome:
        outcome = env.drive(baseline(env))
        total += reward(outcome)
    episode = env.episode
    return Drive(episode.seed, outcome.label, episode.hit, total, episode.steps)


BASELINES: dict[str, Callable[[], Baseline]] = {
    "planner": Planner,
    "never_turn": lambda: never_turn,
    "random": RandomActions,
}
