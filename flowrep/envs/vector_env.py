"""Envs of one scene in one process, stepped one by one and rendered together."""

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space, create_empty_array
from numpy.typing import NDArray

from flowrep.envs.sensing import EPISODE_SEEDS
from flowrep.envs.street_env import NOTHING_HIT, Episode, Outcome
from flowrep.envs.workers import copy_into_rows

_STATUS: dict[str, Any] = {
    "outcome": spaces.Box(0, len(Outcome) - 1, (1,), np.uint8),
    "hit": spaces.Box(0, NOTHING_HIT, (1,), np.uint8),
    "episode_seed": spaces.Box(0, EPISODE_SEEDS - 1, (1,), np.int64),
    "path": spaces.Box(0, 1 << 31, (1,), np.int64),
    "vehicle": spaces.Box(-np.inf, np.inf, (3,), np.float32),
}


class StreetVectorEnv(SyncVectorEnv):
    """`StreetEnv`s that are drawn together; the observation contains the status of their episodes.

    Without autoreset, an env is stepped on until it is reset; with `AutoresetMode.NEXT_STEP`, the
    step after an episode's last one begins the next episode instead.

    | key | shape | dtype | meaning |
    | --- | --- | --- | --- |
    | `sensor` | | | the observation of the `StreetEnv`; absent without sensors |
    | `outcome` | [1] | uint8 | code of `flowrep.envs.Outcome`; 0 while the episode runs |
    | `hit` | [1] | uint8 | class id of what was hit; 255 for nothing |
    | `episode_seed` | [1] | int64 | identifies the episode, see `StreetEnv.reset` |
    | `path` | [1] | int64 | index of the episode's path in the scene |
    | `vehicle` | [3] | float32 | x and y in metres and yaw in radians, in the world |

    Observations are bitwise equal to those of the single envs. Later steps don't change them.

    Raises:
        ValueError: the envs differ in scene, sensors or `picture_scale`.
    """

    num_workers = 0

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env]],
        autoreset_mode: AutoresetMode = AutoresetMode.DISABLED,
    ) -> None:
        super().__init__(env_fns, autoreset_mode=autoreset_mode)
        self._streets: list[Any] = [env.unwrapped for env in self.envs]
        cameras = {street.sensing for street in self._streets}
        if len(cameras) != 1:
            raise ValueError(
                "environments that are drawn together need the same scene, sensors and "
                "picture_scale; make a vector env for each"
            )
        sensor: Any = self.single_observation_space
        nested: dict[str, spaces.Space] = {"sensor": sensor} if sensor.spaces else {}
        self.single_observation_space = spaces.Dict(nested | _STATUS)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._is_idle = [False] * self.num_envs
        nothing = create_empty_array(self.single_observation_space, self.num_envs, np.zeros)
        self._latest: Any = nothing

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins episodes in all envs, or in those marked by `options["reset_mask"]`.

        Args:
            seed: the seed of the first env, with consecutive seeds for the others; or one for each.
            options: for every episode, see `StreetEnv.reset`. `episodes` holds further options for
                each env, or None to leave it idle until its next reset. An idle env ignores
                actions, gets no reward, and keeps its last observation.
        """
        options = dict(options or {})
        mask = options.pop("reset_mask", np.ones(self.num_envs, dtype=bool))
        episodes = options.pop("episodes", None) or [{}] * self.num_envs
        seeds = range(seed, seed + self.num_envs) if isinstance(seed, int | np.integer) else seed
        due = np.flatnonzero(mask).tolist()
        self._autoreset_envs[due] = False
        for i in due:
            self._is_idle[i] = episodes[i] is None
            if not self._is_idle[i]:
                seed_of_env = None if seeds is None else seeds[i]
                self._streets[i].begin(seed=seed_of_env, options=options | episodes[i])
        return self._observe([i for i in due if not self._is_idle[i]]), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[dict[str, Any], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Steps all envs that are not idle."""
        rewards, ended = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=bool)
        driven = [i for i in range(self.num_envs) if not self._is_idle[i]]
        for i in driven:
            if self._autoreset_envs[i]:
                self._streets[i].begin()
            else:
                rewards[i], ended[i] = self._streets[i].drive(np.asarray(actions[i]).item())
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            self._autoreset_envs = ended.copy()
        return self._observe(driven), rewards, ended, np.zeros_like(ended), {}

    def _observe(self, rows: list[int]) -> dict[str, Any]:
        """Renders some envs; the others keep their last observation, which is 0 at first."""
        if not rows:
            return deepcopy(self._latest)
        episodes = [self._streets[row].episode for row in rows]
        sensor = self._streets[0].sensing.observe_all(episodes)
        observation = ({"sensor": sensor} if sensor else {}) | _status(episodes)
        if len(rows) < self.num_envs:
            # The caller may still use the arrays of an earlier step: copy them before writing.
            self._latest = deepcopy(self._latest)
            copy_into_rows(observation, self._latest, rows)
        else:
            self._latest = observation
        return dict(self._latest)


def _status(episodes: Sequence[Episode]) -> dict[str, NDArray[Any]]:
    numbers = [each.status() | {"vehicle": each.now.vehicle[:3]} for each in episodes]
    return {
        name: np.array([each[name] for each in numbers], space.dtype).reshape(-1, *space.shape)
        for name, space in _STATUS.items()
    }
