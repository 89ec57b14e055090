"""Splits an update among cores into tasks large enough that threads hardly wait for each other.

PyTorch splits each of an update's several hundred operations, and all threads wait for each other
after each one. They wait in a busy loop: if a core is also used by something else, they take the
time that the thread they wait for needs, and an update takes many times as long. Here each thread
computes whole chains of operations on a part of the batch, and sleeps once no task is left. The
division into tasks does not depend on the number of threads, so neither do the results.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import pairwise
from queue import SimpleQueue
from threading import Thread
from typing import TypeVar

import torch

Task = Callable[[], object]
T = TypeVar("T")


class Team:
    """The calling thread and `size - 1` helper threads, which compute without gradients.

    In a team of several, each PyTorch operation runs on a single thread.

    Args:
        size: number of threads, including the caller's.
    """

    def __init__(self, size: int) -> None:
        if size < 1:
            raise ValueError(f"a team needs at least one thread, got size={size}")
        self.size = size
        self._calls: list[SimpleQueue[Work | None]] = [SimpleQueue() for _ in range(size - 1)]
        for calls in self._calls:
            Thread(target=_help, args=(calls,), name="flowrep team", daemon=True).start()

    def run(self, tasks: Iterable[Task]) -> None:
        """Runs all tasks, in any order, and returns when the last one has ended.

        Raises:
            Exception: the first one that a task raised; the other tasks still run.
        """
        work = Work(tasks)
        for calls in self._calls[: len(work.tasks) - 1]:
            calls.put(work)
        with torch.no_grad(), nullcontext() if self.size == 1 else one_thread_an_operation():
            work.take()
        work.wait()

    def begin(self, task: Callable[[], T]) -> Callable[[], T]:
        """Has another thread run a task meanwhile, if the team has one.

        Returns:
            A function that waits for the task's result, and runs the task if nobody has begun to;
            it raises what the task raised.
        """
        results: list[T] = []
        work = Work([lambda: results.append(task())])
        for calls in self._calls[:1]:
            calls.put(work)

        def finish() -> T:
            with torch.no_grad():
                work.take()
            work.wait()
            return results[0]

        return finish

    def dismiss(self) -> None:
        """Ends the helper threads; from then on the caller works alone."""
        for calls in self._calls:
            calls.put(None)
        self._calls, self.size = [], 1


class Work:
    """Tasks from which any thread takes the next one."""

    def __init__(self, tasks: Iterable[Task]) -> None:
        self.tasks = deque(tasks)
        self._left = len(self.tasks)
        self._ended: SimpleQueue[Exception | None] = SimpleQueue()

    def take(self) -> None:
        """Runs one task after another until none is left to begin."""
        while True:
            try:
                task = self.tasks.popleft()
            except IndexError:
                return
            try:
                task()
            except Exception as error:  # the waiting thread raises it
                self._ended.put(error)
            else:
                self._ended.put(None)

    def wait(self) -> None:
        """Sleeps until all have ended; raises the first error."""
        errors = [self._ended.get() for _ in range(self._left)]
        for error in errors:
            if error is not None:
                raise error


@contextmanager
def one_thread_an_operation() -> Iterator[None]:
    """Makes PyTorch compute each operation on one thread during the block."""
    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _help(calls: SimpleQueue[Work | None]) -> None:
    torch.set_num_threads(1)  # both settings are per thread
    torch.set_grad_enabled(False)
    while (work := calls.get()) is not None:
        work.take()
        del work  # its tasks hold tensors


_team = Team(1)


def use_threads(count: int) -> None:
    """Sets the number of threads that compute this process's updates on the CPU.

    PyTorch still splits operations outside of updates. If those are small, that is slower than
    `torch.set_num_threads(1)`, and much slower on a busy machine.
    """
    global _team
    _team.dismiss()
    _team = Team(count)


def threads_in_use() -> int:
    """Returns how many threads compute this process's updates on the CPU."""
    return max(_team.size, torch.get_num_threads())


def run_tasks(tasks: Iterable[Task]) -> None:
    """Runs tasks on the threads set by `use_threads`, by default one after another.

    Raises:
        Exception: the first one that a task raised.
    """
    _team.run(tasks)


def begin_task(task: Callable[[], T]) -> Callable[[], T]:
    """Begins a task on another thread, if `use_threads` has set several; see `Team.begin`."""
    return _team.begin(task)


def parts(length: int, largest: int) -> list[slice]:
    """Returns slices of about equal size, at most `largest`, that together cover `length`."""
    count = max(1, -(-length // largest))
    bounds = [length * i // count for i in range(count + 1)]
    return [slice(start, end) for start, end in pairwise(bounds)]
