"""A process that holds several environments and executes commands one at a time."""

import os
import signal
import traceback
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
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


class WorkerError(RuntimeError):
    """A worker process failed or died; the message names its environments."""


class Worker:
    """The caller's side of a process that holds the environments of `rows`."""

    def __init__(
        self,
        context: Any,
        env_factories: Sequence[EnvFactory],
        rows: slice,
        memory: Any,
        in_each: VectorFactory,
    ) -> None:
        self.rows = rows
        self.pipe, theirs = context.Pipe()
        arguments = (theirs, list(env_factories[rows]), rows, memory, len(env_factories), in_each)
        self.process = context.Process(target=_work, args=arguments, daemon=True)
        self.process.start()
        theirs.close()
        self._owes_answer = True

    @property
    def name(self) -> str:
        """The environments that it holds, in words."""
        first, last = self.rows.start, self.rows.stop - 1
        return f"environment {first}" if first == last else f"environments {first} to {last}"

    def send(self, command: str, arguments: tuple[Any, ...]) -> None:
        """Sends a command, after dropping any answer that was not fully received."""
        if self._owes_answer:
            self.receive()
        try:
            self.pipe.send((command, arguments))
            self._owes_answer = True
        except OSError as error:
            raise self._gone() from error

    def receive(self) -> Any:
        """Waits for the answer to the last command; the first answer names the code it runs."""
        try:
            failure, answer = self.pipe.recv()
            self._owes_answer = False
        except (EOFError, OSError) as error:
            raise self._gone() from error
        if failure is not None:
            raise WorkerError(f"the worker process of {self.name} failed:\n{failure}")
        return answer

    def end(self) -> None:
        """Waits briefly for the process to notice that its pipe is closed."""
        self.process.join(timeout=5.0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process.close()

    def _gone(self) -> WorkerError:
        self.process.join(timeout=1.0)
        code = self.process.exitcode
        reason = f"exit code {code}"
        if code is not None and code < 0:
            reason = signal.Signals(-code).name
        return WorkerError(
            f"the worker process of {self.name} is gone ({reason}): perhaps the system killed it "
            "for want of memory, or the script that defines its environments lacks an "
            '`if __name__ == "__main__":`'
        )


def _work(
    pipe: Connection,
    env_factories: list[EnvFactory],
    rows: slice,
    memory: Any,
    num_envs: int,
    in_each: VectorFactory,
) -> None:
    """Executes commands until the other end of the pipe is closed."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    vector = None
    try:
        vector = in_each(env_factories)
        shared = sliced(views(vector.single_observation_space, memory, num_envs), rows)
        pipe.send((None, os.path.realpath(__file__)))
        while True:
            command, arguments = pipe.recv()
            pipe.send((None, _COMMANDS[command](vector, shared, *arguments)))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the caller has closed, or is gone
    except Exception:
        pipe.send((traceback.format_exc(), None))
    finally:
        if vector is not None:
            vector.close()


def _reset(
    vector: SyncVectorEnv,
    shared: Arrays,
    seeds: list[int | None],
    mask: NDArray[np.bool_],
    options: dict[str, Any],
) -> None:
    if mask.any():
        observation, _ = vector.reset(seed=seeds, options=options | {"reset_mask": mask})
        _copy(observation, shared)


def _step(vector: SyncVectorEnv, shared: Arrays, actions: NDArray[Any]) -> tuple[Any, ...]:
    observation, *outcome, _ = vector.step(actions)
    _copy(observation, shared)
    return tuple(outcome)


def _call_all(
    vector: SyncVectorEnv, shared: Arrays, name: str, args: Any, kwargs: Any
) -> tuple[Any, ...]:
    return vector.call(name, *args, **kwargs)


def _call_each(vector: SyncVectorEnv, shared: Arrays, name: str, arguments: list[Any]) -> list[Any]:
    return [env.get_wrapper_attr(name)(given) for env, given in zip(vector.envs, arguments)]


def _advance(vector: Any, shared: Arrays, orders: Sequence[Order]) -> list[Any]:
    return vector.advance(orders, shared.get("sensor", {}))


def _apply(
    vector: SyncVectorEnv, shared: Arrays, function: Callable[[gym.Env, Any], Any], argument: Any
) -> Any:
    return function(vector.envs[0], argument)


_COMMANDS: dict[str, Callable[..., Any]] = {
    "reset": _reset,
    "step": _step,
    "call": _call_all,
    "call_each": _call_each,
    "advance": _advance,
    "apply": _apply,
}


def views(space: gym.Space, memory: Any, num_envs: int) -> Arrays:
    """Returns the shared memory of a `Dict` space as writable arrays [num_envs, ...]."""
    views: Any = read_from_shared_memory(space, memory, num_envs)
    return _map(np.asarray, views)


def sliced(arrays: Arrays, rows: slice) -> Arrays:
    """Returns views of the given rows."""
    return _map(lambda array: array[rows], arrays)


def copied(arrays: Arrays) -> Arrays:
    """Returns copies."""
    return _map(np.copy, arrays)


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
