"""Environments stepped in parallel in several processes, several in each."""

import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from itertools import pairwise
from multiprocessing import forkserver, get_context, resource_tracker, util
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space, create_shared_memory, read_from_shared_memory
from numpy.typing import NDArray

Arrays = dict[str, Any]  # arrays, nested like a Dict space
EnvFactory = Callable[[], gym.Env]
VectorFactory = Callable[[Sequence[EnvFactory]], SyncVectorEnv]

_SIDE_BY_SIDE = partial(SyncVectorEnv, copy=False, autoreset_mode=AutoresetMode.DISABLED)
_PRELOADED = "flowrep.envs.vector_env"  # imported once, by the server that workers are forked from


class WorkerError(RuntimeError):
    """A worker process failed or died; the message names it."""


class WorkerVectorEnv(VectorEnv):
    """Several environments in each of several processes, behind gymnasium's vector interface.

    It behaves like a `SyncVectorEnv` with autoreset disabled: the same seeds and actions give the
    same numbers, bit for bit, for any number of workers. Infos are not passed on. Gymnasium's
    `AsyncVectorEnv` made 386 to 403 frames/s where this one made 464 to 524, and Ctrl-C kills its
    workers.

    Observations come back through shared memory, everything else through pipes. `step_async` begins
    a step, so that the caller can do other work until it calls `step` for the outcome.

    Workers are forked from a server that has imported neither PyTorch nor the caller's main module.
    They don't react to SIGINT and SIGTERM, which terminals and schedulers send to whole process
    groups, and end when the caller closes them or dies.

    Args:
        env_factories: one picklable factory for each environment, from a module that can be
            imported; all environments have the same spaces, with a `Dict` of observations.
        num_workers: number of processes, at most one for each environment.
        in_each: makes a vector env without autoreset from the environments of one worker.

    Raises:
        ValueError: if there are fewer environments than workers.
        WorkerError: if a worker could not start; any method raises it once a worker has stopped.
    """

    def __init__(
        self,
        env_factories: Sequence[EnvFactory],
        num_workers: int,
        in_each: VectorFactory = _SIDE_BY_SIDE,
    ) -> None:
        """Starts the workers and waits until they have built their environments."""
        if not 1 <= num_workers <= len(env_factories):
            raise ValueError(
                f"num_workers is {num_workers} for {len(env_factories)} environments; "
                "give one environment at least to each worker, and one worker at least"
            )
        self.num_envs, self.num_workers = len(env_factories), num_workers
        self.autoreset_mode = AutoresetMode.DISABLED
        example = env_factories[0]()
        self.metadata = example.metadata | {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space = example.observation_space
        self.single_action_space = example.action_space
        example.close()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._begun: NDArray[Any] | None = None  # the actions of a step that is under way
        bounds = np.linspace(0, self.num_envs, num_workers + 1).round().astype(int).tolist()
        self._rows = [slice(*ends) for ends in pairwise(bounds)]
        self._workers: list[_Worker] = []
        # At exit, multiprocessing would wait for ever for processes that SIGTERM does not reach.
        self._end = util.Finalize(self, _end, args=(self._workers,), exitpriority=10)
        context: Any = get_context("forkserver")
        context.set_forkserver_preload([_PRELOADED])
        with sheltered():
            forkserver.ensure_running()
            memory = create_shared_memory(self.single_observation_space, self.num_envs, context)
            for rows in self._rows:
                make = partial(_Environments, env_factories[rows], rows, memory, in_each)
                self._workers.append(_Worker(context, partial(make, self.num_envs), _name(rows)))
        self._shared = _views(self.single_observation_space, memory, self.num_envs)
        self._receive()

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Arrays, dict[str, Any]]:
        """Begins episodes in all environments, or in those marked by `options["reset_mask"]`.

        The outcome of a step under way is dropped.

        Args:
            seed: of the first environment, with consecutive seeds for the others; or one for each.
            options: passed to every worker's `reset`, except `reset_mask`, bool [num_envs], and
                `episodes` of `StreetVectorEnv`, of which each gets its own part.
        """
        self.drop_step()
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        episodes = options.pop("episodes", None)
        if isinstance(seed, int):
            seed = range(seed, seed + self.num_envs)
        seeds = [None] * self.num_envs if seed is None else list(seed)
        if mask.shape != (self.num_envs,) or len(seeds) != self.num_envs:
            raise ValueError(
                f"reset: seeds and reset_mask should be one for each of {self.num_envs} "
                f"environments, got {len(seeds)} seeds and a mask {mask.shape}"
            )

        def arguments(rows: slice) -> tuple[Any, ...]:
            part = {} if episodes is None else {"episodes": episodes[rows]}
            return seeds[rows], mask[rows], options | part

        self._call("reset", arguments)
        return deepcopy(self._shared), {}

    def step_async(self, actions: NDArray[Any]) -> None:
        """Begins a step; `step` with the same actions waits for it and returns its outcome."""
        if self._begun is not None:
            raise RuntimeError("a step is under way: call step() for its outcome first")
        actions = np.array(actions)
        self._send("step", lambda rows: (actions[rows],))
        self._begun = actions

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Arrays, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Takes a step, or returns the outcome of the one that `step_async` began."""
        if self._begun is None:
            self.step_async(actions)
        elif not np.array_equal(self._begun, actions):
            raise ValueError(f"step_async began a step with {self._begun}, step got {actions}")
        self._begun = None
        rewards, terminated, truncated = map(np.concatenate, zip(*self._receive()))
        return deepcopy(self._shared), rewards, terminated, truncated, {}

    def drop_step(self) -> None:
        """Waits for a step under way and discards its outcome."""
        if self._begun is not None:
            self._begun = None
            self._receive()

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Returns the result of a method, or the value of an attribute, for each environment."""
        self.drop_step()
        return self._call("call", lambda rows: (name, args, kwargs))

    def call_each(self, name: str, arguments: Sequence[Any]) -> tuple[Any, ...]:
        """Returns the result of a method called with one argument for each environment."""
        self.drop_step()
        return self._call("call_each", lambda rows: (name, list(arguments[rows])))

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the workers."""
        self._end()

    def _call(self, method: str, arguments: Callable[[slice], tuple[Any, ...]]) -> tuple[Any, ...]:
        self._send(method, arguments)
        return tuple(result for results in self._receive() for result in results)

    def _send(self, method: str, arguments: Callable[[slice], tuple[Any, ...]]) -> None:
        if not self._workers:
            raise WorkerError("the workers have ended, by close() or by a failure before")
        with self._ending_together():
            for worker, rows in zip(self._workers, self._rows):
                worker.send(method, arguments(rows))

    def _receive(self) -> list[Any]:
        with self._ending_together():
            return [worker.receive() for worker in self._workers]

    @contextmanager
    def _ending_together(self) -> Iterator[None]:
        # The other workers' answers are useless without the failed one's.
        try:
            yield
        except WorkerError:
            self._end()
            raise


class _Answer(NamedTuple):
    content: Any = ()
    failure: str | None = None


class _Worker:
    """The caller's side of a process that makes an object and calls its methods."""

    def __init__(self, context: Any, make: Callable[[], Any], name: str) -> None:
        self.name = name
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, make), daemon=True)
        self.process.start()
        theirs.close()
        self.owes_answer = True  # that the object is made

    def send(self, method: str, arguments: tuple[Any, ...]) -> None:
        """Calls a method; an answer that nobody waited for, after an interrupt, is dropped."""
        if self.owes_answer:
            self.receive()
        try:
            self.pipe.send((method, arguments))
            self.owes_answer = True
        except OSError as error:
            raise self._gone() from error

    def receive(self) -> Any:
        """Waits for what the method returned."""
        try:
            answer: _Answer = self.pipe.recv()
            self.owes_answer = False
        except (EOFError, OSError) as error:
            raise self._gone() from error
        if answer.failure is not None:
            raise WorkerError(f"the worker process of {self.name} failed:\n{answer.failure}")
        return answer.content

    def _gone(self) -> WorkerError:
        self.process.join(timeout=1.0)
        code = self.process.exitcode
        reason = f"exit code {code}" if code is None or code >= 0 else signal.Signals(-code).name
        return WorkerError(
            f"the worker process of {self.name} is gone ({reason}): perhaps the system killed it "
            "for want of memory"
        )


def _end(workers: list[_Worker]) -> None:
    """Closes the pipes, upon which workers end, and waits for that."""
    for worker in workers:
        worker.pipe.close()
    for worker in workers:
        worker.process.join(timeout=5.0)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()
    workers.clear()


def _work(pipe: Connection, make: Callable[[], Any]) -> None:
    """Makes an object and calls its methods, until the other end of the pipe is closed."""
    made = None
    try:
        made = make()
        pipe.send(_Answer())
        while True:
            method, arguments = pipe.recv()
            pipe.send(_Answer(getattr(made, method)(*arguments)))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the caller has closed, or is gone
    except Exception:
        pipe.send(_Answer(failure=traceback.format_exc()))
    finally:
        if made is not None:
            made.close()


@contextmanager
def sheltered() -> Iterator[None]:
    """Starts processes that signals don't reach and that do not run the main module again.

    A process inherits the mask of blocked signals, so there is no moment at which Ctrl-C could
    print a traceback from each worker. Running `python -m flowrep.train` again, as multiprocessing
    does, would import PyTorch in each.
    """
    resource_tracker.ensure_running()  # which unblocks signals when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Environments:
    """The environments of one worker, which write observations into their rows of shared memory."""

    def __init__(
        self,
        env_factories: Sequence[EnvFactory],
        rows: slice,
        memory: Any,
        in_each: VectorFactory,
        num_envs: int,
    ) -> None:
        self._vector: Any = in_each(env_factories)
        everything = _views(self._vector.single_observation_space, memory, num_envs)
        self._shared = _map(lambda array: array[rows], everything)

    def reset(
        self, seeds: list[int | None], mask: NDArray[np.bool_], options: dict[str, Any]
    ) -> tuple[()]:
        if mask.any():
            observation, _ = self._vector.reset(seed=seeds, options=options | {"reset_mask": mask})
            _copy(observation, self._shared)
        return ()

    def step(self, actions: NDArray[Any]) -> tuple[Any, ...]:
        observation, *outcome, _ = self._vector.step(actions)
        _copy(observation, self._shared)
        return tuple(outcome)

    def call(self, name: str, args: Any, kwargs: Any) -> tuple[Any, ...]:
        return self._vector.call(name, *args, **kwargs)

    def call_each(self, name: str, arguments: list[Any]) -> list[Any]:
        pairs = zip(self._vector.envs, arguments)
        return [env.get_wrapper_attr(name)(given) for env, given in pairs]

    def close(self) -> None:
        self._vector.close()


def available_cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _name(rows: slice) -> str:
    first, last = rows.start, rows.stop - 1
    return f"environment {first}" if first == last else f"environments {first} to {last}"


def _views(space: gym.Space, memory: Any, num_envs: int) -> Arrays:
    """Returns the shared memory of a `Dict` space as writable arrays [num_envs, ...]."""
    views: Any = read_from_shared_memory(space, memory, num_envs)
    return _map(np.asarray, views)


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
