"""Environments stepped in parallel in several processes, several in each."""

import atexit
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import traceback
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from itertools import pairwise
from multiprocessing import connection, forkserver, resource_tracker, util
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space, create_shared_memory, read_from_shared_memory
from numpy.typing import NDArray

_FOLDER = "FLOWREP_WORKER_SERVER_FOLDER"
_LONGEST_FOLDER = 107 - len("/listener-12345678")  # bytes: a socket's path has 107 at most


def worker_context(module: str, num_workers: int) -> Any:
    """Returns a multiprocessing context that starts workers.

    Several are forked from a server, which is running by then and imports what they need once. A
    single one is a new interpreter, since a server beside it would only hold a second copy of that.

    SIGINT and SIGTERM, which terminals and schedulers send to whole process groups, never reach the
    server or workers started under `signals_held`. They end when the caller closes them or dies.

    Args:
        module: imported by the server, with its own imports, if no server is running yet.
        num_workers: the number of workers that will be started together.

    Raises:
        OSError: the path of the folder for temporary files is too long for the server's socket.
    """
    resource_tracker.ensure_running()  # which unblocks signals when it starts
    if num_workers == 1:
        return multiprocessing.get_context("spawn")
    context: Any = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([module])
    with signals_held(), _folder_told():
        forkserver.ensure_running()
    return context


@contextmanager
def signals_held() -> Iterator[None]:
    """Blocks SIGINT and SIGTERM during the block, permanently in processes started in it.

    A process inherits the mask, and multiprocessing does not change it. A worker whose caller is
    interrupted while starting it would print an error about its incomplete arguments.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _folder_told() -> Iterator[None]:
    folder = util.get_temp_dir()
    if len(os.fsencode(folder)) > _LONGEST_FOLDER:
        raise OSError(f"'{folder}' is too long for sockets: shorten TMPDIR, or set num_workers=0")
    os.environ[_FOLDER] = folder
    try:
        yield
    finally:
        del os.environ[_FOLDER]


if _FOLDER in os.environ:
    # This runs in the server. The caller removes the folder of its socket; a killed caller can't,
    # and its server outlives it for a moment.
    atexit.register(shutil.rmtree, os.environ.pop(_FOLDER), ignore_errors=True)


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


class WorkerError(RuntimeError):
    """A worker process failed or died; the message names it."""


class _Message(NamedTuple):
    """A part of an answer; the last one of each answer is marked."""

    failure: str | None = None
    content: Any = None
    is_last: bool = True


class Worker:
    """The caller's side of a process.

    Args:
        context: of multiprocessing.
        make: picklable; called in the process, returns the object whose methods are called. Its
            `close` is called at the end.
        name: what the process holds, in words.
    """

    def __init__(self, context: Any, make: Callable[[], Any], name: str) -> None:
        """Starts the process; its first answer is the file of the code it runs."""
        self.name = name
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, make), daemon=True)
        self.process.start()
        theirs.close()
        self.owes_answer = True

    def send(self, method: str, arguments: tuple[Any, ...]) -> None:
        """Calls a method, after dropping what was not received of the answer before."""
        while self.owes_answer:
            self.receive()
        try:
            self.pipe.send((method, arguments))
            self.owes_answer = True
        except OSError as error:
            raise self._gone() from error

    def receive(self) -> Any:
        """Waits for the next part of the answer.

        That is what the method returned, or what it yielded, with None as the last part.
        """
        try:
            message: _Message = self.pipe.recv()
            self.owes_answer = not message.is_last
        except (EOFError, OSError) as error:
            raise self._gone() from error
        if message.failure is not None:
            raise WorkerError(f"the worker process of {self.name} failed:\n{message.failure}")
        return message.content

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


def _work(pipe: Connection, make: Callable[[], Any]) -> None:
    """Calls methods until the other end of the pipe is closed."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    made = None
    try:
        made = make()
        _answer(pipe, os.path.realpath(__file__))
        while True:
            method, arguments = pipe.recv()
            _answer(pipe, getattr(made, method)(*arguments))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the caller has closed, or is gone
    except Exception:
        pipe.send(_Message(failure=traceback.format_exc()))
    finally:
        if made is not None:
            made.close()


def _answer(pipe: Connection, result: Any) -> None:
    if isinstance(result, Iterator):
        for item in result:
            pipe.send(_Message(content=item, is_last=False))
        result = None
    pipe.send(_Message(content=result))


class WorkerGroup:
    """Processes that hold an object each; when one fails, all are ended.

    Several are forked from a server process; like a single one, which is started anew, they hold
    none of the caller's threads or CUDA state. They ignore SIGINT and SIGTERM, which terminals and
    schedulers send to whole process groups, and end when the caller closes them or dies. A script
    that defines classes of its own, instead of importing them from a module, is run again by each
    worker and needs an `if __name__ == "__main__":` guard.

    Args:
        makers: what each process holds, in words, and the picklable function that makes it there.
        given: the part of it that comes from the caller, perhaps from the caller's script.
        module: what the processes need; imported by the server, unless an earlier group started it.

    Raises:
        WorkerError: if a worker could not be started; all methods raise it once one has stopped.
    """

    def __init__(self, makers: Mapping[str, Callable[[], Any]], given: Any, module: str) -> None:
        """Starts the processes, without waiting until they are ready."""
        self.workers: list[Worker] = []
        self._is_ready = False
        context = worker_context(module, len(makers))
        # The interpreter would wait at exit for processes that ignore signals.
        self._at_exit = partial(_call, weakref.WeakMethod(self.close))
        atexit.register(self._at_exit)
        needs_main = _needs_main_module(given)
        try:
            with signals_held(), nullcontext() if needs_main else _without_main_module():
                for name, make in makers.items():
                    self.workers.append(Worker(context, make, name))
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        return len(self.workers)

    def wait_until_ready(self) -> None:
        """Waits until every process has made its object, and checks that it runs this code."""
        if self._is_ready:
            return
        try:
            files = self.receive()
        except BaseException:
            self.close()
            raise
        # A new interpreter looks for modules in the current folder first.
        ours = os.path.realpath(__file__)
        if others := set(files) - {ours}:
            self.close()
            raise WorkerError(
                f"workers found another copy of this package ({others.pop()}) than this process "
                f"({ours}): start from another folder than {os.getcwd()}"
            )
        self._is_ready = True

    def send(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> None:
        """Calls a method in each process, with the arguments of each."""
        self._check_that_they_live()
        with self._ending_with_a_failure():
            for worker, given in zip(self.workers, arguments, strict=True):
                worker.send(method, given)

    def receive(self) -> list[Any]:
        """Waits for all answers and returns them in the workers' order."""
        with self._ending_with_a_failure():
            return [worker.receive() for worker in self.workers]

    def stream(
        self, method: str, arguments: Sequence[tuple[Any, ...]], own: Iterator[Any]
    ) -> Iterator[tuple[int, Any]]:
        """Yields what a generator method yields in all processes, as it comes.

        Args:
            method: its name.
            arguments: for each worker; an item is yielded with the worker's index.
            own: this process's part of the work, yielded with the index after the last worker's.
        """
        self.send(method, arguments)
        busy = {worker.pipe: (number, worker) for number, worker in enumerate(self.workers)}
        with self._ending_with_a_failure():
            for item in own:
                yield len(self.workers), item
                yield from _arrived(busy, timeout_s=0.0)
            while busy:
                yield from _arrived(busy, timeout_s=None)

    def apply(self, method: str, arguments: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Yields the index and result of each call, made in any free process, as they end."""
        self._check_that_they_live()
        waiting = enumerate(arguments)
        busy: dict[Any, tuple[Worker, int]] = {}
        free = list(self.workers)
        with self._ending_with_a_failure():
            while True:
                for worker, (number, given) in zip(free, waiting):
                    worker.send(method, given)
                    busy[worker.pipe] = worker, number
                if not busy:
                    return
                free = []
                for pipe in connection.wait(list(busy)):
                    worker, number = busy.pop(pipe)
                    free.append(worker)
                    yield number, worker.receive()

    def close(self) -> None:
        """Ends the processes."""
        workers, self.workers = self.workers, []
        for worker in workers:
            worker.pipe.close()
        for worker in workers:
            worker.end()
        atexit.unregister(self._at_exit)

    def _check_that_they_live(self) -> None:
        if not self.workers:
            raise WorkerError("the workers have ended, by close() or by a failure before")

    @contextmanager
    def _ending_with_a_failure(self) -> Iterator[None]:
        # The other workers' answers are useless without the failed one's.
        try:
            yield
        except WorkerError:
            self.close()
            raise


def _arrived(
    busy: dict[Any, tuple[int, Worker]], timeout_s: float | None
) -> Iterator[tuple[int, Any]]:
    """Yields what has come from busy workers, one item of each; removes those that are done."""
    for pipe in connection.wait(list(busy), timeout_s):
        number, worker = busy[pipe]
        item = worker.receive()
        if worker.owes_answer:
            yield number, item
        else:
            del busy[pipe]


@contextmanager
def _without_main_module() -> Iterator[None]:
    """Stops multiprocessing from running the main module again in new processes."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _needs_main_module(given: Any) -> bool:
    try:
        with _without_main_module():
            pickle.dumps(given)
    except (pickle.PicklingError, AttributeError):
        return True
    return False


def _call(method: weakref.WeakMethod[Any]) -> None:
    if (alive := method()) is not None:
        alive()


_SIDE_BY_SIDE = partial(SyncVectorEnv, copy=False, autoreset_mode=AutoresetMode.DISABLED)


class WorkerVectorEnv(VectorEnv):
    """Several environments in each of several processes, behind gymnasium's vector interface.

    It behaves like a `SyncVectorEnv` with autoreset disabled: the same seeds and actions give the
    same numbers, bit for bit, for any number of workers. Infos are not passed on. Gymnasium's
    `AsyncVectorEnv` made 386 to 403 frames/s where this one made 464 to 524, and Ctrl-C kills its
    workers.

    Observations come back through shared memory, everything else through pipes. `step_async` begins
    a step, so that the caller can do other work until it calls `step` for the outcome.

    See `WorkerGroup` for how the workers live and end.

    Args:
        env_factories: one picklable factory for each environment; all environments have the same
            spaces, with a `Dict` of observations.
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
        self.num_envs = len(env_factories)
        self.autoreset_mode = AutoresetMode.DISABLED
        example = env_factories[0]()
        self.metadata = example.metadata | {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space = example.observation_space
        self.single_action_space = example.action_space
        example.close()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        # made in the context of the processes that will open it
        context = worker_context(__name__, num_workers)
        memory = create_shared_memory(self.single_observation_space, self.num_envs, context)
        self._shared = views(self.single_observation_space, memory, self.num_envs)
        self._begun: NDArray[Any] | None = None  # the actions of a step that is under way
        bounds = np.linspace(0, self.num_envs, num_workers + 1).round().astype(int).tolist()
        self._rows = [slice(*ends) for ends in pairwise(bounds)]
        self._group = WorkerGroup(
            {
                _name(rows): partial(
                    WorkerEnvironments, env_factories[rows], rows, memory, self.num_envs, in_each
                )
                for rows in self._rows
            },
            given=env_factories,
            module=__name__,
        )
        self._group.wait_until_ready()

    @property
    def num_workers(self) -> int:
        """The number of processes."""
        return len(self._group)

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
            options: passed to every environment's `reset`, except `reset_mask`, bool [num_envs].
        """
        self.drop_step()
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if isinstance(seed, int):
            seed = range(seed, seed + self.num_envs)
        seeds = [None] * self.num_envs if seed is None else list(seed)
        if mask.shape != (self.num_envs,) or len(seeds) != self.num_envs:
            raise ValueError(
                f"reset: seeds and reset_mask should be one for each of {self.num_envs} "
                f"environments, got {len(seeds)} seeds and a mask {mask.shape}"
            )
        self._send("reset", lambda rows: (seeds[rows], mask[rows], options))
        self._group.receive()
        return copied(self._shared), {}

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
        rewards, terminated, truncated = map(np.concatenate, zip(*self._group.receive()))
        return copied(self._shared), rewards, terminated, truncated, {}

    def drop_step(self) -> None:
        """Waits for a step under way and discards its outcome."""
        if self._begun is not None:
            self._begun = None
            self._group.receive()

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Returns the result of a method, or the value of an attribute, for each environment."""
        self.drop_step()
        self._send("call", lambda rows: (name, args, kwargs))
        return tuple(result for results in self._group.receive() for result in results)

    def call_each(self, name: str, arguments: Sequence[Any]) -> tuple[Any, ...]:
        """Returns the result of a method called with one argument for each environment."""
        self.drop_step()
        self._send("call_each", lambda rows: (name, list(arguments[rows])))
        return tuple(result for results in self._group.receive() for result in results)

    def advance(self, orders: Sequence[Order]) -> tuple[Arrays, list[Any]]:
        """Executes one order per environment; requires workers with `StreetVectorEnv`s.

        Returns:
            Observations `[num_envs, ...]` by sensor, in memory that the next call overwrites, and
            the state of each episode. See `StreetVectorEnv.advance`.
        """
        self.drop_step()
        self._send("advance", lambda rows: (orders[rows],))
        standings = [standing for part in self._group.receive() for standing in part]
        return self._shared.get("sensor", {}), standings

    def apply(
        self, function: Callable[[gym.Env, Any], Any], arguments: Iterable[Any]
    ) -> Iterator[tuple[int, Any]]:
        """Yields the index and result of each call, in order of completion.

        Args:
            function: picklable; called with an environment of any free worker.
            arguments: one for each call.
        """
        self.drop_step()
        yield from self._group.apply("apply", ((function, argument) for argument in arguments))

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the workers."""
        self._group.close()

    def _send(self, method: str, arguments: Callable[[slice], tuple[Any, ...]]) -> None:
        self._group.send(method, [arguments(rows) for rows in self._rows])


def available_cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _name(rows: slice) -> str:
    first, last = rows.start, rows.stop - 1
    return f"environment {first}" if first == last else f"environments {first} to {last}"
