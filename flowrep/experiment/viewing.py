"""Drives for viewing a scene: path, observations and outcome of each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrep.baselines.baselines import Baseline
from flowrep.envs.street_env import StreetEnv
from flowrep.palette import CATEGORY_ID

Look = Callable[[Mapping[str, Any]], None]


@dataclass(frozen=True)
class Viewed:
    """One finished episode and where its vehicle drove, points [T + 1, 2] in metres."""

    episode_seed: int
    path: str
    outcome: str
    hit: str
    steps: int
    total_reward: float
    points_m: NDArray[np.float64]

    def row(self) -> dict[str, Any]:
        """Returns its row in a table."""
        return {
            "episode_seed": self.episode_seed,
            "path": self.path,
            "outcome": self.outcome,
            "hit": self.hit,
            "steps": self.steps,
            "return": round(self.total_reward, 2),
        }


def view_episode(
    env: StreetEnv,
    baseline: Baseline,
    *,
    look: Look | None = None,
    seed: int | None = None,
    path: str | None = None,
) -> Viewed:
    """Drives one episode to its end and returns it.

    Args:
        env: the environment.
        baseline: chooses the actions.
        look: called with every observation, that of the reset first.
        seed: as for `StreetEnv.reset`; None continues with the env's own episodes.
        path: one of the scene's paths, drawn if None.
    """
    observation, info = env.reset(seed=seed, options=None if path is None else {"path": path})
    points, total, ended = [env.episode.now.vehicle[:2]], 0.0, False
    if look is not None:
        look(observation)
    while not ended:
        observation, reward, ended, _, info = env.step(baseline(env))
        total += reward
        points.append(env.episode.now.vehicle[:2])
        if look is not None:
            look(observation)
    return Viewed(
        info["episode_seed"],
        info["path"],
        info["outcome"],
        info["hit"],
        env.episode.steps,
        total,
        np.array(points, dtype=np.float64),
    )


class CategoryCount:
    """Counts the pixels of each category and the pictures that show it."""

    def __init__(self, categories: tuple[str, ...]) -> None:
        """Starts at 0 for the categories of a scene."""
        self.categories = categories
        self._pixels = np.zeros(256, dtype=np.int64)
        self._pictures = np.zeros(256, dtype=np.int64)
        self._seen = 0

    def __call__(self, observation: Mapping[str, Any]) -> None:
        """Adds the semantic map of an observation."""
        pixels = np.bincount(np.asarray(observation["semantic"]).ravel(), minlength=256)
        self._pixels += pixels
        self._pictures += pixels > 0
        self._seen += 1

    def rows(self) -> list[dict[str, Any]]:
        """Returns each category's share of the pixels and of the pictures, in %."""
        total = max(1, int(self._pixels.sum()))
        return [
            {
                "category": name,
                "pixels": int(self._pixels[CATEGORY_ID[name]]),
                "pixels_percent": round(100 * self._pixels[CATEGORY_ID[name]] / total, 3),
                "pictures_percent": round(
                    100 * self._pictures[CATEGORY_ID[name]] / max(1, self._seen), 1
                ),
            }
            for name in self.categories
        ]
