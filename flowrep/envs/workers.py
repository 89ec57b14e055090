"""Envs stepped in parallel by several processes, several envs in each."""

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from itertools import pairwise
from multiprocessing import forkserver, get_context, resource_tracker, util
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space, create_shared_memory, read_from_shared_memory
from numpy.typing import NDArray

from flowrep.progress import STOP_SIGNALS

Arrays = dict[str, Any]  # arrays, nested like a Dict space
EnvFactory = Callable[[], gym.Env]
VectorFactory = Callable[[Sequence[EnvFactory]], SyncVectorEnv]

_SIDE_BY_SIDE = partial(SyncVectorEnv, copy=False, autoreset_mode=AutoresetMode.DISABLED)

PATIENCE_S = 300.0
"""How long a worker may take to answer: it starts in seconds and steps in milliseconds, but the
machine may be busy."""
PATIENCE_AT_THE_END_S = 5.0
"""How long workers may take to end before they are killed."""


class WorkerError(RuntimeError):
    """A worker process failed, died or doesn't answer; the message names its envs."""


class WorkerVectorEnv(VectorEnv):
    """Several envs in each of several processes, behind gymnasium's vector interface.

    It behaves like a `SyncVectorEnv` with autoreset disabled: the same seeds and actions give the
    same numbers, bit for bit, for any number of workers. Infos are not passed on.

    Gymnasium's `AsyncVectorEnv` has one process per env. It reached 386 to 403 frames/s where this
    class reached 464 to 524, and Ctrl-C kills its workers. TorchRL's `ParallelEnv` over two envs of
    16 streets reached 0.60 of this class's frames/s with 32 streets on two cores (ego and obj; 0.64
    with seg; medians of seven rounds in turn), and can't step while the caller computes.

    Observations come back through shared memory, everything else through pipes. Workers ignore
    SIGINT, SIGTERM and SIGHUP, which terminals and schedulers send to whole process groups. They
    end when the caller closes them or dies.

    Args:
        env_factories: one picklable factory for each env, from a module that can be imported; all
            envs have the same spaces, with a `Dict` of observations.
        num_workers: number of processes, at most one for each env; `experiment.build` turns the
            commands' `auto` into it.
        in_each: makes a vector env without autoreset from the envs of one worker.

    Raises:
        ValueError: there are more workers than envs.
        WorkerError: a worker could not start; any method raises it if a worker has ended or does
            not answer.
    """

    def __init__(
        self,
        env_factories: Sequence[EnvFactory],
        num_workers: int,
        in_each: VectorFactory = _SIDE_BY_SIDE,
    ) -> None:
        self.num_envs, self.num_workers = len(env_factories), num_workers
        if not 1 <= num_workers <= self.num_envs:
            raise ValueError(
                f"num_workers is {num_workers} for {self.num_envs} environments; give at "
                "most one worker for each"
            )
        self.autoreset_mode = AutoresetMode.DISABLED
        example = in_each(env_factories[:1])
        self.metadata, space = example.metadata, example.single_observation_space
        self.single_observation_space = space
        self.single_action_space = example.single_action_space
        example.close()
        self.observation_space = batch_space(space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._begun: NDArray[Any] | None = None  # the actions of a step that has begun
        # Each worker's rows of the batch, as even as possible: 5 envs in 3 workers are 2, 1 and 2.
        bounds = np.linspace(0, self.num_envs, num_workers + 1).round().astype(int).tolist()
        self._rows = [slice(*ends) for ends in pairwise(bounds)]
        self._workers: list[_Worker] = []
        # At exit, multiprocessing sends SIGTERM and waits. Workers ignore SIGTERM, so close them
        # before that.
        self._end = util.Finalize(self, _end, args=(self._workers,), exitpriority=10)
        # fork would copy the locks that PyTorch's threads hold. spawn would import gymnasium, numpy
        # and PyBullet in each worker; a fork server imports them once.
        context: Any = get_context("forkserver")
        context.set_forkserver_preload(["flowrep.envs.vector_env"])
        with sheltered():
            forkserver.ensure_running()
            memory = create_shared_memory(space, self.num_envs, context)
            for rows in self._rows:
                arguments = env_factories[rows], memory, self.num_envs, in_each
                self._workers.append(_Worker(context, rows, *arguments))
        self._shared: Any = read_from_shared_memory(space, memory, self.num_envs)
        for worker in self._workers:
            worker.receive()

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Arrays, dict[str, Any]]:
        """Begins episodes like `SyncVectorEnv`; drops the outcome of a step that has begun.

        The options `reset_mask`, bool [num_envs], and `episodes`, see `StreetVectorEnv.reset`, are
        split among the workers; all others go to each.
        """
        shared = {"reset_mask": np.ones(self.num_envs, dtype=bool), **(options or {})}
        split = [name for name in ("reset_mask", "episodes") if shared.get(name) is not None]
        if isinstance(seed, int | np.integer):
            seed = range(seed, seed + self.num_envs)
        seeds = [None] * self.num_envs if seed is None else list(seed)

        def arguments(rows: slice) -> dict[str, Any]:
            part = {name: shared[name][rows] for name in split}
            return {"seed": seeds[rows], "options": shared | part}

        self._call("reset", arguments)
        return deepcopy(self._shared), {}

    def step_async(self, actions: NDArray[Any]) -> None:
        """Begins a step; `step` with the same actions waits for it and returns its outcome."""
        if self._begun is not None:
            raise RuntimeError("a step is under way: call step() for its outcome first")
        actions = np.array(actions)
        self._send("step", lambda rows: {"actions": actions[rows]})
        self._begun = actions

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Arrays, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Takes a step, or returns the outcome of the step that `step_async` began."""
        if self._begun is None:
            self.step_async(actions)
        elif not np.array_equal(self._begun, actions):
            raise ValueError(f"step_async began a step with {self._begun}, step got {actions}")
        self._begun = None
        # Copy, because workers write observations into shared memory, where the next step
        # overwrites them.
        outcomes = [worker.receive()[:3] for worker in self._workers]
        rewards, terminated, truncated = map(np.concatenate, zip(*outcomes))
        return deepcopy(self._shared), rewards, terminated, truncated, {}

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Returns the result of a method, or the value of an attribute, for each env."""
        results = self._call("call", lambda rows: {"name": name, "args": args, "kwargs": kwargs})
        return tuple(result for of_worker in results for result in of_worker)

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the workers."""
        self._end()

    def _call(self, method: str, arguments: Callable[[slice], dict[str, Any]]) -> list[Any]:
        self._send(method, arguments)
        return [worker.receive() for worker in self._workers]

    def _send(self, method: str, arguments: Callable[[slice], dict[str, Any]]) -> None:
        if not self._workers:
            raise WorkerError("the workers have ended: close() was called")
        self._begun = None
        for worker, rows in zip(self._workers, self._rows):
            worker.send(method, arguments(rows))


class _Worker:
    """The main process's side of a process that steps envs."""

    def __init__(self, context: Any, rows: slice, *arguments: Any) -> None:
        self.name = f"environments {rows.start} to {rows.stop - 1}"
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, rows, *arguments), daemon=True)
        self.process.start()
        theirs.close()
        self._owes_answer = True  # it answers once its envs exist

    def send(self, method: str, arguments: dict[str, Any]) -> None:
        if self._owes_answer:  # to a step that was dropped, or to a call that was interrupted
            self.receive()
        self._talk(self.pipe.send, (method, arguments))
        self._owes_answer = True

    def receive(self) -> Any:
        result, failure = self._talk(self._receive_within_patience)
        self._owes_answer = False
        if failure:
            raise WorkerError(f"the worker process of {self.name} failed:\n{failure}")
        return result

    def _receive_within_patience(self) -> Any:
        if not self.pipe.poll(PATIENCE_S):
            pid = self.process.pid
            raise WorkerError(
                f"the worker process of {self.name} has not answered for {PATIENCE_S:g} s: if "
                f"process {pid} is suspended, resume it with 'kill -CONT {pid}'"
            )
        return self.pipe.recv()

    def _talk(self, act: Callable[..., Any], *args: Any) -> Any:
        try:
            return act(*args)
        except (EOFError, OSError) as error:
            self.process.join(timeout=1.0)
            raise WorkerError(
                f"the worker process of {self.name} is gone (exit code {self.process.exitcode}): "
                "its last output says why; after -9, perhaps memory ran out"
            ) from error


def _end(workers: list[_Worker]) -> None:
    """Closes the pipes, which ends the workers, and waits for them."""
    for worker in workers:
        worker.pipe.close()
    deadline = time.monotonic() + PATIENCE_AT_THE_END_S
    for worker in workers:
        worker.process.join(timeout=max(0.0, deadline - time.monotonic()))
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
    workers.clear()


def _work(
    pipe: Connection,
    rows: slice,
    env_factories: Sequence[EnvFactory],
    memory: Any,
    num_envs: int,
    in_each: VectorFactory,
) -> None:
    """Calls methods of a vector env until the other end of the pipe is closed."""
    vector: Any = None
    try:
        vector = in_each(env_factories)
        shared: Any = read_from_shared_memory(vector.single_observation_space, memory, num_envs)
        pipe.send((None, None))
        while True:
            method, arguments = pipe.recv()
            if method == "call":
                result = vector.call(arguments["name"], *arguments["args"], **arguments["kwargs"])
            elif method == "reset" and not arguments["options"]["reset_mask"].any():
                result = ()  # gymnasium's vector env refuses this call
            else:
                observation, *result = getattr(vector, method)(**arguments)
                copy_into_rows(observation, shared, rows)
            pipe.send((result, None))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the main process has closed the pipe, or is gone
    except Exception:
        pipe.send((None, traceback.format_exc()))
    finally:
        if vector is not None:  # building its envs may have failed
            vector.close()


def copy_into_rows(source: Mapping[str, Any], target: Mapping[str, Any], rows: Any) -> None:
    """Copies arrays that are nested in mappings into some rows of those in `target`."""
    for name, value in source.items():
        if isinstance(value, Mapping):
            copy_into_rows(value, target[name], rows)
        else:
            target[name][rows] = value


@contextmanager
def sheltered() -> Iterator[None]:
    """Starts processes with signals blocked, and keeps them from running the main module again."""
    # A process inherits the mask of blocked signals. If it blocked them itself, Ctrl-C just before
    # that would print a traceback from each worker, or end multiprocessing's resource tracker.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    resource_tracker.ensure_running()  # which unblocks some of them when it starts
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    # Running the main module again, as multiprocessing does, would import PyTorch in each.
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def available_cores() -> int:
    """Returns how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
