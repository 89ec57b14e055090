"""Shares an update out among cores in pieces so large that its threads hardly wait for each other.

PyTorch's own way is to split every operation, some hundreds an update, and to have each thread wait
for all others at the end of each. Such threads spin: where a core is busy with something else, they
burn the time that the thread they are waiting for needs, and an update takes many times as long.
Here each thread computes whole chains of operations on a part of the batch, and sleeps when there
is nothing left to take. How the work is cut does not depend on the number of threads, so neither
do the numbers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import pairwise
from queue import SimpleQueue
from threading import Thread

import torch

Task = Callable[[], object]


class Team:
    """The calling thread and `size - 1` helpers; all compute without gradients.

    A team of several takes one thread for each of PyTorch's own operations.

    Args:
        size: threads that work at the same time, the caller's among them.
    """

    def __init__(self, size: int) -> None:
        if size < 1:
            raise ValueError(f"a team has one thread at least, got size={size}")
        self.size = size
        self._calls: list[SimpleQueue[Work | None]] = [SimpleQueue() for _ in range(size - 1)]
        for calls in self._calls:
            Thread(target=_help, args=(calls,), name="flowrep team", daemon=True).start()

    def run(self, tasks: Iterable[Task]) -> None:
        """Carries all tasks out, in any order, and returns when the last one has ended.

        Raises:
            Exception: the first one that a task raised; the others are carried out all the same.
        """
        work = Work(tasks)
        for calls in self._calls[: len(work.tasks) - 1]:
            calls.put(work)
        with torch.no_grad(), nullcontext() if self.size == 1 else _one_thread_an_operation():
            work.take()
        work.wait()

    def dismiss(self) -> None:
        """Lets the helpers end; the caller works alone from then on."""
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
        """Carries out one task after the other until none is left to begin."""
        while True:
            try:
                task = self.tasks.popleft()
            except IndexError:
                return
            try:
                task()
            except Exception as error:  # it belongs to the thread that waits
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
def _one_thread_an_operation() -> Iterator[None]:
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
    torch.set_num_threads(1)  # both are a thread's own settings
    torch.set_grad_enabled(False)
    while (work := calls.get()) is not None:
        work.take()
        del work  # its tasks hold tensors


_team = Team(1)


def use_threads(count: int) -> None:
    """Has `count` threads compute this process's updates on the CPU, from now on.

    PyTorch goes on splitting operations outside of them. Where those are small, that is slower than
    `torch.set_num_threads(1)`, and much slower on a machine that is busy with more.
    """
    global _team
    _team.dismiss()
    _team = Team(count)


def threads_in_use() -> int:
    """Returns how many threads compute this process's updates on the CPU."""
    return max(_team.size, torch.get_num_threads())


def run_tasks(tasks: Iterable[Task]) -> None:
    """Carries tasks out by the threads that `use_threads` has set; one after the other by default.

    Raises:
        Exception: the first one that a task raised.
    """
    _team.run(tasks)


def parts(length: int, largest: int) -> list[slice]:
    """Returns slices of about the same size, none above `largest`, that together are `length`."""
    count = max(1, -(-length // largest))
    bounds = [length * i // count for i in range(count + 1)]
    return [slice(start, end) for start, end in pairwise(bounds)]
