"""Several worker processes that end together."""

import atexit
import os
import pickle
import sys
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from multiprocessing import connection
from types import ModuleType
from typing import Any

from flowrep.envs import worker_process
from flowrep.envs.worker_process import Worker, WorkerError
from flowrep.envs.worker_server import signals_held, worker_context


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
        ours = os.path.realpath(worker_process.__file__)
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
