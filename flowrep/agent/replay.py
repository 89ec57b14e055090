"""Replay of stored maps: a storage, a sampler and a transform for a TorchRL replay buffer.

Each observation is stored once. A row holds the observed maps, the action, the reward and the end
flags; the next observation is in the row of the next step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import LazyTensorStorage, RoundRobinWriter, Storage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.envs import Transform

from flowrep.agent.map_codec import MapCodec, store_maps

OUTCOME = ("reward", "done", "terminated")
TRAJECTORIES = ("collector", "traj_ids")  # written by TorchRL's collectors


class ReplayMemory(TensorDictReplayBuffer):
    """TorchRL's replay buffer with `RowStorage`, `SuccessorSampler` and `PackSteps`.

    `sample` returns `batch_size` transitions, uniform with replacement: the maps, stored, `action`,
    `steps_to_next_obs` `[batch_size, 1]` and, under `next`, the maps, `reward` (the discounted sum
    over those steps), `done` and `terminated`.

    Args:
        codecs: the maps to store; see `flowrep.agent.map_codec`.
        capacity: number of rows; beyond it, the oldest row is overwritten.
        batch_size: number of transitions in a sample.
        device: where rows are stored.
        n_steps: see `SuccessorSampler`, as for `gamma`.
    """

    def __init__(
        self,
        codecs: Sequence[MapCodec],
        *,
        capacity: int,
        batch_size: int,
        device: torch.device | str,
        n_steps: int = 1,
        gamma: float = 1.0,
    ) -> None:
        keys = [codec.key for codec in codecs]
        super().__init__(
            storage=RowStorage(capacity, device=device, observation_keys=keys),
            sampler=SuccessorSampler(n_steps, gamma),
            writer=RoundRobinWriter(),
            transform=PackSteps(codecs),
            batch_size=batch_size,
        )

    def add(self, data: TensorDictBase) -> int:
        """Stores one step of a single env and returns its row."""
        return int(self.extend(data.reshape(1)))


class PackSteps(Transform):
    """Turns steps into rows on `extend`. Samples don't change; losses decode their maps.

    | steps, on `extend` | rows |
    | --- | --- |
    | `[N]`, `[N, T]`, or with a dim named `time` | `[T * N]`, time first |
    | the maps | uint8, or floats of 16 bits (`MapCodec.stored_dtype`) |
    | `action`, `is_init` | unchanged |
    | `("next", name)` of `reward`, `done`, `terminated` | `name` |
    | | `env`: index of the env, from 0 to N - 1 |

    By a TorchRL collector's trajectories, a batch of other envs, as from the next worker of a
    `MultiAsyncCollector`, doesn't continue the last one, and a flattened batch is refused.
    """

    def __init__(self, codecs: Sequence[MapCodec]) -> None:
        self.codecs = tuple(codecs)
        self._latest: Tensor | None = None  # the trajectory of each env's last step
        super().__init__(in_keys=[codec.key for codec in codecs])

    def _inv_call(self, steps: TensorDictBase) -> TensorDictBase:
        if "is_init" not in steps:
            raise KeyError(
                "steps lack 'is_init', a mark of restarts: append TorchRL's InitTracker to the env"
            )
        keys = [*self.in_keys, "action", "is_init", *[("next", name) for name in OUTCOME]]
        keys += [TRAJECTORIES] if TRAJECTORIES in steps.keys(True) else []
        steps = time_first(steps.select(*keys))
        if TRAJECTORIES in keys:
            steps["is_init"] = self._with_marks(steps["is_init"], steps[TRAJECTORIES])
        times, envs = steps.batch_size
        steps = steps.reshape(-1)
        rows = store_maps(self.codecs, steps).update(steps["next"])
        rows["action"], rows["is_init"] = steps["action"], steps["is_init"]
        rows["env"] = torch.arange(envs, dtype=torch.int32, device=rows.device).repeat(times)
        return rows

    def _with_marks(self, is_init: Tensor, trajectories: Tensor) -> Tensor:
        """Returns `is_init` `[T, N, 1]`, True also where a trajectory isn't the last batch's."""
        first, before, self._latest = trajectories[0], self._latest, trajectories[-1].clone()
        if (count := len(first.unique())) < len(first):
            raise ValueError(
                f"{len(first)} steps side by side are of {count} trajectories: extend by a "
                "collector's batch as it is, without reshape(-1) or flatten_tensordicts"
            )
        if before is None or before.shape != first.shape:
            return is_init
        other = expand_as_right(first != before, is_init[0])
        return torch.cat([(is_init[0] | other).unsqueeze(0), is_init[1:]])

    def forward(self, transitions: TensorDictBase) -> TensorDictBase:
        """Returns a sample unchanged."""
        return transitions


class RowStorage(LazyTensorStorage):
    """A TorchRL storage that also returns transitions, and saves only the rows that are written."""

    _storage: Any

    def __init__(
        self,
        max_size: int,
        *,
        observation_keys: Sequence[NestedKey],
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(max_size, device=device)
        self.observation_keys = tuple(observation_keys)

    def get(self, index: Any) -> TensorDictBase:
        """Returns rows; for pairs of rows `[N, 2]`, transitions `[N]`.

        A transition has the first row's maps and `action`, and the second's maps under `next`.
        """
        if not (isinstance(index, Tensor) and index.ndim == 2 and self.initialized):
            return super().get(index)
        # Indexing a TensorDict with a tensor takes 2.4 times as long as index_select.
        first, following = index.unbind(1)
        transitions = TensorDict({}, first.shape, device=self._storage.device)
        for key in self.observation_keys:
            maps = self._storage.get(key)
            transitions.set(key, maps.index_select(0, first))
            transitions.set(("next", key), maps.index_select(0, following))
        return transitions.set("action", self._storage.get("action").index_select(0, first))

    def state_dict(self) -> dict[str, Any]:
        """Returns the written rows, without a copy, and the capacity."""
        rows = self._storage[: len(self)].to_dict() if self.initialized else None
        return {"capacity": self.max_size, "rows": rows, "size": len(self)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a `state_dict` of a storage of the same capacity."""
        if state["capacity"] != self.max_size:
            raise ValueError(
                f"the saved replay memory has capacity {state['capacity']}, this one "
                f"{self.max_size}; set replay_capacity={state['capacity']}"
            )
        self._storage, self.initialized, self._len = None, False, 0
        if state["rows"] is not None:
            rows = TensorDict(state["rows"], [state["size"]])
            self.set(torch.arange(len(rows)), rows)


class SuccessorSampler(Sampler):
    """Draws pairs of rows, uniform with replacement: the first step of a transition and the next.

    A step can be drawn once the next step of its env is stored. A terminal step has no next step,
    so its own row is used instead, and `terminated` masks the value. If the episode was truncated
    (`done` without `terminated`) or the next row `is_init`, the next observation was never stored,
    and the step is not drawn.

    A transition spans `n_steps` steps, whose rewards are discounted by `gamma`. It is shorter if
    its episode ends before, or if the next step is not stored. Each `extend` must add whole steps
    of all envs, as with `PackSteps`.
    """

    def __init__(self, n_steps: int = 1, gamma: float = 1.0) -> None:
        if n_steps < 1:
            raise ValueError(f"n_steps is {n_steps}: a transition spans at least 1 step")
        self.n_steps, self.gamma = n_steps, gamma
        self._empty()

    def _empty(self) -> None:
        self._next_row = torch.empty(0, dtype=torch.long)  # -1: the next step is not stored
        self._latest = torch.empty(0, dtype=torch.long)  # each env's row; -1: its episode ended

    def mark_update(self, index: Tensor, *, storage: Storage) -> None:
        """Links each row just written to the previous row of its env."""
        rows = storage[:]
        marks = [rows[name].flatten() for name in ("env", "done", "terminated", "is_init")]
        written = torch.stack([mark[index.to(mark.device)].long() for mark in marks]).cpu()
        env, (done, terminated, is_init) = written[0], written[1:].bool()
        index, envs = index.cpu(), int(env.max()) + 1
        if len(index) + envs > storage.max_size:
            raise ValueError(
                f"a replay capacity of {storage.max_size} cannot take {len(index) // envs} steps "
                f"of {envs} envs; it has to hold {len(index) + envs}: raise "
                "replay_capacity or lower num_envs"
            )
        if not len(self._next_row):
            self._next_row = torch.full((storage.max_size,), -1)
        # This also forgets the links of the rows that are overwritten.
        self._next_row[index] = torch.where(terminated, index, -1)
        # `before` and `after` pair each step with the previous one, which is `envs` rows back.
        ahead = torch.where(done | terminated, -1, index)
        known = self._latest if len(self._latest) == envs else self._latest[:0]
        before = torch.cat([known, ahead[:-envs]])
        after = slice(len(index) - len(before), None)
        follows = (before >= 0) & ~is_init[after]
        self._next_row[before[follows]] = index[after][follows]
        self._latest = ahead[-envs:].clone()

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[NestedKey, Tensor]]:
        """Returns the rows `[batch_size, 2]`, and reward, end flags and step count between them."""
        usable = (self._next_row >= 0).nonzero().squeeze(-1)
        if not len(usable):
            raise RuntimeError("nothing to sample: extend the replay memory by two steps first")
        rows = storage[:]
        first = usable[torch.randint(len(usable), (batch_size,), generator=self._rng)]
        last, reward, steps = self._look_ahead(rows["reward"], first)
        info: dict[NestedKey, Tensor] = {"steps_to_next_obs": steps, ("next", "reward"): reward}
        for name in ("done", "terminated"):
            info["next", name] = rows[name].index_select(0, last.to(reward.device))
        return torch.stack([first, self._next_row[last]]).mT, info

    def _look_ahead(self, rewards: Tensor, first: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns transitions' last rows `[N]`, discounted rewards and step counts `[N, 1]`."""
        last, steps = first, torch.ones(len(first), 1)
        reward = rewards.index_select(0, first.to(rewards.device))
        for _ in range(self.n_steps - 1):
            ahead = self._next_row[last]
            # A terminal step is its own successor, and a step without one can't be the last.
            goes_on = (ahead != last) & (self._next_row[ahead] >= 0)
            last = torch.where(goes_on, ahead, last)
            # γ to the power of the steps so far, or 0 where the transition has ended.
            weight = (self.gamma**steps * goes_on[:, None]).to(rewards.device)
            reward = reward + weight * rewards.index_select(0, last.to(rewards.device))
            steps = steps + goes_on[:, None]
        return last, reward, steps

    def state_dict(self) -> dict[str, Any]:
        """Returns the links."""
        return {"next_row": self._next_row, "latest": self._latest}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a `state_dict`."""
        self._next_row, self._latest = state["next_row"].clone(), state["latest"].clone()

    def dumps(self, path: str | Path) -> None:
        """Writes the links to a file in the folder `path`, which is created if needed."""
        Path(path).mkdir(exist_ok=True)
        torch.save(self.state_dict(), Path(path) / "links.pt")

    def loads(self, path: str | Path) -> None:
        """Restores the file that `dumps` wrote."""
        self.load_state_dict(torch.load(Path(path) / "links.pt", weights_only=True))


def time_first(frames: TensorDictBase) -> TensorDictBase:
    """Returns frames of N envs as `[T, N]`.

    A dim named `time` is T. Without one, a single dim is N, and the last of several dims is T.
    """
    names = list(frames.names)
    if "time" not in names and frames.ndim < 2:
        return frames.reshape(1, -1)
    time = names.index("time") if "time" in names else frames.ndim - 1
    frames = frames.permute(time, *[dim for dim in range(frames.ndim) if dim != time])
    return frames.reshape(frames.shape[0], -1)
