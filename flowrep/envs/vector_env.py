"""Environments of one scene in one process, stepped one by one and rendered together."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import create_empty_array
from numpy.typing import NDArray

from flowrep.envs.episode import NOTHING_HIT, Outcome, hit_code, reward
from flowrep.envs.sensing import observe_together
from flowrep.envs.workers import Order, copied

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


class StreetVectorEnv(SyncVectorEnv):
    """A faster `SyncVectorEnv` for `StreetEnv`s, without autoreset and infos.

    Its results are identical, bit for bit, and belong to the caller.

    Args:
        env_fns: make `SensorObservation`s of one scene with the same sensors.
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]]) -> None:
        """Makes the environments."""
        super().__init__(env_fns, autoreset_mode=AutoresetMode.DISABLED)
        self._streets: list[Any] = [env.unwrapped for env in self.envs]
        self._latest: Any = create_empty_array(
            self.single_observation_space, self.num_envs, np.zeros
        )

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins episodes in all environments, or in those marked by `options["reset_mask"]`."""
        options = dict(options or {})
        mask = options.pop("reset_mask", np.ones(self.num_envs, dtype=bool))
        seeds = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed
        due = np.flatnonzero(mask).tolist()
        for i in due:
            self._streets[i].begin(seed=None if seeds is None else seeds[i], options=options)
        return self._observe(due), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[dict[str, Any], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Steps all environments."""
        for street, action in zip(self._streets, actions.tolist(), strict=True):
            street.drive(action)
        outcomes = [street.episode.outcome for street in self._streets]
        rewards = np.array([reward(outcome) for outcome in outcomes])
        ended = np.array([outcome != Outcome.RUNNING for outcome in outcomes])
        everyone = list(range(self.num_envs))
        return self._observe(everyone), rewards, ended, np.zeros_like(ended), {}

    def advance(
        self, orders: Sequence[Order], into: Mapping[str, NDArray[Any]]
    ) -> list[tuple[str, str] | None]:
        """Executes one order per environment, and renders those whose episode continues.

        Args:
            orders: one for each environment: an action to take a step, options of `StreetEnv.reset`
                to begin an episode, or None to do nothing.
            into: arrays `[num_envs, ...]` by sensor, in which the rendered rows are written.

        Returns:
            The outcome's name and the category hit for each environment with an order, None for the
            others.
        """
        for street, order in zip(self._streets, orders, strict=True):
            if isinstance(order, Mapping):
                street.begin(options=dict(order))
            elif order is not None:
                street.drive(order)
        asked = [None if order is None else s.episode for s, order in zip(self._streets, orders)]
        rows = [i for i, episode in enumerate(asked) if episode and not episode.outcome]
        if rows:
            streets = [self._streets[row] for row in rows]
            seen = observe_together([s.sensing for s in streets], [s.episode for s in streets])
            for name, values in seen.items():
                into[name][rows] = values
        return [episode and (episode.outcome.label, episode.hit) for episode in asked]

    def _observe(self, rows: list[int]) -> dict[str, Any]:
        """Renders some environments; the others keep their last observation, at first zeros."""
        if not rows:
            return copied(self._latest)
        streets = [self._streets[row] for row in rows]
        episodes = [street.episode for street in streets]
        seen = observe_together([street.sensing for street in streets], episodes)
        status = episode_status(
            [episode.outcome for episode in episodes],
            [episode.hit for episode in episodes],
            [episode.seed for episode in episodes],
        )
        if len(rows) < self.num_envs:
            # Arrays returned before belong to the caller: copy them instead of writing to them.
            seen = _replaced(self._latest.get("sensor", {}), seen, rows)
            status = _replaced(self._latest, status, rows)
        self._latest = ({"sensor": seen} if seen else {}) | status
        return dict(self._latest)


def _replaced(
    before: dict[str, NDArray[Any]], new: dict[str, NDArray[Any]], rows: list[int]
) -> dict[str, NDArray[Any]]:
    merged = {name: before[name].copy() for name in new}
    for name, values in new.items():
        merged[name][rows] = values
    return merged
