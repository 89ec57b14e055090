"""The environments that one worker process holds, which write into shared memory."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv
from gymnasium.vector.utils import read_from_shared_memory
from numpy.typing import NDArray

EnvFactory = Callable[[], gym.Env]
VectorFactory = Callable[[Sequence[EnvFactory]], SyncVectorEnv]
Order = int | Mapping[str, Any] | None  # an action, reset options, or nothing
Arrays = dict[str, Any]  # arrays, nested like a Dict space


class WorkerEnvironments:
    """Some environments of a `WorkerVectorEnv`.

    Args:
        env_factories: one for each of its environments.
        rows: their places among all environments.
        memory: shared by all workers.
        num_envs: the number of all environments.
        in_each: makes a vector env of those held here.
    """

    def __init__(
        self,
        env_factories: Sequence[EnvFactory],
        rows: slice,
        memory: Any,
        num_envs: int,
        in_each: VectorFactory,
    ) -> None:
        """Makes the environments."""
        self._vector: Any = in_each(env_factories)
        self._shared = _sliced(views(self._vector.single_observation_space, memory, num_envs), rows)

    def reset(
        self, seeds: list[int | None], mask: NDArray[np.bool_], options: dict[str, Any]
    ) -> None:
        """Begins episodes in the environments of a mask."""
        if mask.any():
            observation, _ = self._vector.reset(seed=seeds, options=options | {"reset_mask": mask})
            _copy(observation, self._shared)

    def step(self, actions: NDArray[Any]) -> tuple[Any, ...]:
        """Steps all environments and returns their rewards, terminated and truncated."""
        observation, *outcome, _ = self._vector.step(actions)
        _copy(observation, self._shared)
        return tuple(outcome)

    def call(self, name: str, args: Any, kwargs: Any) -> tuple[Any, ...]:
        """See `WorkerVectorEnv.call`."""
        return self._vector.call(name, *args, **kwargs)

    def call_each(self, name: str, arguments: list[Any]) -> list[Any]:
        """See `WorkerVectorEnv.call_each`."""
        pairs = zip(self._vector.envs, arguments)
        return [env.get_wrapper_attr(name)(given) for env, given in pairs]

    def advance(self, orders: Sequence[Order]) -> list[Any]:
        """See `WorkerVectorEnv.advance`."""
        return self._vector.advance(orders, self._shared.get("sensor", {}))

    def apply(self, function: Callable[[gym.Env, Any], Any], argument: Any) -> Any:
        """Calls a function with the first environment."""
        return function(self._vector.envs[0], argument)

    def close(self) -> None:
        """Closes the environments."""
        self._vector.close()


def views(space: gym.Space, memory: Any, num_envs: int) -> Arrays:
    """Returns the shared memory of a `Dict` space as writable arrays [num_envs, ...]."""
    views: Any = read_from_shared_memory(space, memory, num_envs)
    return _map(np.asarray, views)


def copied(arrays: Arrays) -> Arrays:
    """Returns copies."""
    return _map(np.copy, arrays)


def _sliced(arrays: Arrays, rows: slice) -> Arrays:
    return _map(lambda array: array[rows], arrays)


def _map(change: Callable[[Any], Any], arrays: Mapping[str, Any]) -> Arrays:
    return {
        name: _map(change, value) if isinstance(value, Mapping) else change(value)
        for name, value in arrays.items()
    }


def _copy(source: Mapping[str, Any], target: Arrays) -> None:
    for name, value in source.items():
        if isinstance(value, Mapping):
            _copy(value, target[name])
        else:
            np.copyto(target[name], value)
