"""Observations as `make_env` returns them: sensors, and the status of the episode."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from flowrep.envs.outcome import NOTHING_HIT, Outcome, hit_code

_OUTCOME_CODE = {outcome.label: outcome.value for outcome in Outcome}


class SensorObservation(gym.Wrapper):
    """Nests the observation under "sensor" and adds the status of the episode.

    | key | shape | dtype | meaning |
    | --- | --- | --- | --- |
    | `sensor` | | | the wrapped environment's observation |
    | `outcome` | [1] | uint8 | code of `flowrep.envs.Outcome`; 0 while the episode runs |
    | `hit` | [1] | uint8 | class id of what was hit; 255 for nothing |
    | `episode_seed` | [1] | int64 | identifies the episode, see `StreetEnv.reset` |
    """

    def __init__(self, env: gym.Env) -> None:
        """Wraps a `StreetEnv`."""
        super().__init__(env)
        status: dict[str, spaces.Space] = {
            "outcome": spaces.Box(0, len(Outcome) - 1, (1,), np.uint8),
            "hit": spaces.Box(0, NOTHING_HIT, (1,), np.uint8),
            "episode_seed": spaces.Box(0, (1 << 31) - 1, (1,), np.int64),
        }
        sensor = env.observation_space
        has_sensors = isinstance(sensor, spaces.Dict) and len(sensor.spaces) > 0
        self._names = ("sensor",) if has_sensors else ()
        self.observation_space = spaces.Dict(dict.fromkeys(self._names, sensor) | status)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self.arrange(observation, info), {}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drives one step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self.arrange(observation, info), float(reward), terminated, truncated, {}

    def arrange(self, observation: dict[str, Any], info: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the observation in this wrapper's layout."""
        code = _OUTCOME_CODE[info["outcome"]]
        status = episode_status([code], [info["hit"]], [info["episode_seed"]])
        return dict.fromkeys(self._names, observation) | {k: v[0] for k, v in status.items()}


def sensed(street: Callable[..., gym.Env], sensors: Sequence[str]) -> SensorObservation:
    """Returns a street with sensors; picklable in a partial, and imported without PyTorch."""
    return SensorObservation(street(sensors=sensors))


def episode_status(
    codes: Sequence[int], hits: Sequence[str], seeds: Sequence[int]
) -> dict[str, Any]:
    """Returns outcome, hit and episode seed of N episodes, `[N, 1]` each."""
    return {
        "outcome": np.array(codes, dtype=np.uint8)[:, None],
        "hit": np.array([hit_code(hit) for hit in hits], dtype=np.uint8)[:, None],
        "episode_seed": np.array(seeds, dtype=np.int64)[:, None],
    }
