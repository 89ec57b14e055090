"""Processes that evaluate shares of episodes, each with an env of its own, on a CPU's cores."""

import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache, partial
from multiprocessing import get_context, parent_process
from typing import Any

import torch
from torchrl.envs import EnvBase

from flowrep.agent import keep_freed_memory
from flowrep.envs import WorkerError
from flowrep.envs.workers import sheltered
from flowrep.experiment.evaluation import Episode, evaluate
from flowrep.progress import StopRequest

_stop: Any = None  # an event that ends the shares under way; set by `_begin`


class EvaluationPool:
    """Evaluates in several processes, which start with the first share and are kept.

    Ctrl-C does not reach them, and they end with the caller.
    """

    def __init__(self, num_processes: int) -> None:
        context = get_context("spawn")
        self.num_processes = num_processes
        self._stop = context.Event()
        self._executor = ProcessPoolExecutor(num_processes, context, _begin, (self._stop,))

    def evaluate(
        self,
        make_env: Callable[..., EnvBase],
        num_envs: int,
        jobs: Mapping[str, Mapping[str, Any]],
        stop: StopRequest | None = None,
    ) -> Iterator[tuple[str, Episode]]:
        """Yields episodes, each with its job's name; closing the iterator ends those under way.

        Args:
            make_env: picklable; takes changes of `make_env`'s arguments.
            num_envs: side by side, in all processes together.
            jobs: for each name, arguments of `flowrep.experiment.evaluation.evaluate`.
            stop: ends what is under way.
        """
        each = -(-num_envs // self.num_processes)
        # Sent as they are, tensors would be moved to shared memory, the caller's weights included.
        env = pickle.dumps(partial(make_env, num_envs=each, num_workers=0))
        # Interleaved, so that shares take equally long whatever the speeds of the episodes; two for
        # each process, so that none waits for long for the others.
        count = 2 * self.num_processes
        waiting: dict[Future[list[Episode]], str] = {}
        try:
            with sheltered():
                for name, job in jobs.items():
                    for first in range(min(count, len(job["episodes"]))):
                        share = pickle.dumps({**job, "episodes": job["episodes"][first::count]})
                        waiting[self._executor.submit(_evaluate_share, env, share)] = name
            while waiting and not stop:
                for future in wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED).done:
                    name = waiting.pop(future)
                    for episode in future.result():
                        yield name, episode
        except BrokenProcessPool as error:
            if stop:  # a scheduler's SIGTERM ended all of them
                return
            raise WorkerError(
                "a process of the evaluation is gone: perhaps the system killed it for want of "
                "memory; num_workers=0 needs less"
            ) from error
        finally:
            self._stop.set()
            for future in waiting:
                future.cancel()
            wait(waiting)
            self._stop.clear()

    def close(self) -> None:
        """Ends the processes."""
        self._executor.shutdown()


def can_travel(policy: Any) -> bool:
    """Returns whether a policy can be sent to another process."""
    if not isinstance(policy, torch.nn.Module):  # one of the user's own, whatever it holds
        return False
    try:
        pickle.dumps(policy)
    except (pickle.PicklingError, AttributeError, TypeError, RuntimeError):
        return False
    return True


def _begin(stop: Any) -> None:
    """Prepares a process."""
    global _stop
    _stop = stop
    # by which the executor ends the others if one has died
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGTERM,))
    keep_freed_memory()
    torch.set_num_threads(1)
    # A killed caller leaves processes that wait for work: they hold the queue's other end as well.
    threading.Thread(target=_end_with_caller, daemon=True).start()


def _end_with_caller() -> None:
    caller = parent_process()
    assert caller is not None
    caller.join()
    os._exit(1)


@lru_cache(maxsize=2)  # one that sees, and one without observations
def _made(env: bytes) -> EnvBase:
    return pickle.loads(env)()


def _evaluate_share(env: bytes, share: bytes) -> list[Episode]:
    found = []
    for episode in evaluate(_made(env), **pickle.loads(share)):
        found.append(episode)
        if _stop.is_set():
            break
    return found
