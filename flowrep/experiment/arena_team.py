"""Arenas in this and other processes, which share episodes and cores."""

import pickle
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import torch

from flowrep.agent import keep_freed_memory
from flowrep.baselines.baselines import Drive
from flowrep.envs.workers import WorkerGroup
from flowrep.experiment.arena import Agent, Arena, Job
from flowrep.experiment.env_pool import EnvPool, Options
from flowrep.experiment.evaluation import Episode
from flowrep.scenes.scene import Scene


class ArenaTeam:
    """An `Arena` in this process and each of some others; the episodes are those of a single one.

    The other processes start at once and are waited for by the first call.

    Args:
        scene: a loaded scene.
        agents: the agents that will drive, on the CPU and picklable. Their weights are read anew by
            each `run`.
        num_envs: the number of environments of all processes together.
        num_processes: the number of processes, including this one.
        renderer: see `StreetEnv`.
    """

    def __init__(
        self,
        scene: Scene,
        agents: Sequence[Agent],
        *,
        num_envs: int,
        num_processes: int,
        renderer: str = "auto",
    ) -> None:
        """Makes the environments of this process and starts the others."""
        self._agents = list(agents)
        *shares, own = (len(range(i, num_envs, num_processes)) for i in range(num_processes))
        self._own = _arena(scene, agents, own, renderer)
        self._group = WorkerGroup(
            {
                f"arena {number}": partial(_Member, scene, _packed(agents), share, renderer)
                for number, share in enumerate(shares)
            },
            given=self._agents,
            module=__name__,
        )

    def run(self, jobs: Sequence[Job]) -> Iterator[tuple[int, Episode]]:
        """Yields the jobs' episodes with their numbers, as they end; see `Arena.run`."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield from self._shared("run", jobs, _packed(self._agents))
        finally:
            torch.set_num_threads(threads)

    def drive(self, jobs: Sequence[tuple[str, Options]]) -> Iterator[tuple[int, Drive]]:
        """Yields the episodes of baselines, see `EnvPool.drive`."""
        return self._shared("drive", jobs)

    def close(self) -> None:
        """Closes the environments and ends the other processes."""
        self._own.close()
        self._group.close()

    def _shared(self, method: str, jobs: Sequence[Any], *given: Any) -> Iterator[tuple[int, Any]]:
        self._group.wait_until_ready()
        count = len(self._group) + 1
        *shares, rest = (jobs[first::count] for first in range(count))
        own = getattr(self._own, method)(rest)
        arguments = [(share, *given) for share in shares]
        for first, (number, result) in self._group.stream(method, arguments, own):
            yield first + number * count, result


class _Member:
    """The arena of another process."""

    def __init__(self, scene: Scene, agents: bytes, num_envs: int, renderer: str) -> None:
        keep_freed_memory()
        torch.set_num_threads(1)
        self._arena = _arena(scene, pickle.loads(agents), num_envs, renderer)

    def run(self, jobs: Sequence[Job], agents: bytes) -> Iterator[tuple[int, Episode]]:
        self._arena.agents = pickle.loads(agents)
        return self._arena.run(jobs)

    def drive(self, jobs: Sequence[tuple[str, Options]]) -> Iterator[tuple[int, Drive]]:
        return self._arena.drive(jobs)

    def close(self) -> None:
        self._arena.close()


def _arena(scene: Scene, agents: Sequence[Agent], num_envs: int, renderer: str) -> Arena:
    return Arena(scene, agents, partial(EnvPool, num_envs=num_envs, renderer=renderer))


AnyArena = Arena | ArenaTeam


def can_travel(agents: Sequence[Agent]) -> bool:
    """Returns whether agents can be sent to another process and drive there."""
    if any(torch.device(agent.device).type != "cpu" for agent in agents):
        return False
    try:
        _packed(agents)
    except (pickle.PicklingError, AttributeError, TypeError, RuntimeError):
        return False
    return True


def _packed(agents: Sequence[Agent]) -> bytes:
    # Sent as they are, tensors would be moved to shared memory, the caller's weights included.
    return pickle.dumps(list(agents))
