"""What the agent remembers: packed maps, each stored once, sampled uniformly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from flowrep.agent.observation import MapCodec, store_maps


class ReplayMemory:
    """A ring of transitions that stores an observation once, not again as the one before's next.

    A slot holds the maps seen, the action taken and what it brought; `next` is looked up in the
    slot of the frame that followed. A transition can be sampled as soon as that frame is known, so
    the latest step of each environment waits for the following one. Where an episode terminated
    there is nothing to look up: its value is masked by `terminated`, and the slot's own maps stand
    in. Where it was cut off without terminating (`truncated`, or a restart between two calls) the
    following frame was never stored, and the transition is left out of the samples.

    Args:
        codecs: the maps to keep; see `flowrep.agent.observation`.
        capacity: slots; the oldest transition is overwritten.
        batch_size: transitions a sample, drawn with replacement.
        device: where frames are kept and samples appear.
        n_steps: steps that a sampled transition spans at most; it ends earlier where its episode
            does, or where the frame that follows is not stored.
        gamma: discount a step of the rewards within it.

    Raises:
        ValueError: if n_steps is below 1.
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
        if n_steps < 1:
            raise ValueError(f"n_steps is {n_steps}: a transition spans at least 1 step")
        self.codecs = tuple(codecs)
        self.capacity, self.batch_size = capacity, batch_size
        self.n_steps, self.gamma = n_steps, gamma
        self.device = torch.device(device)
        self._frames: TensorDictBase | None = None  # [capacity], allocated by the first extend
        self._next_slot = torch.full((capacity,), -1)  # -1: the following frame is not stored
        self._cursor = 0
        self._size = 0
        # each environment's latest step: its slot, and the maps it led to as they came
        self._tail: dict[str, Any] | None = None
        self._usable = torch.empty(0, dtype=torch.long)

    def __len__(self) -> int:
        """Returns the number of transitions stored."""
        return self._size

    def extend(self, frames: TensorDictBase) -> None:
        """Stores steps of N environments: `[N]`, `[N, T]`, or as a TorchRL collector returns them.

        Args:
            frames: with the maps, `action` and, under `next`, the maps, `reward`, `done` and
                `terminated`. A dim named `time` is taken as such; without one, a single dim is N.

        Raises:
            ValueError: if the steps, with the N before them, do not fit into the capacity.
        """
        steps = time_first(frames)  # [T, N]
        times, width = steps.batch_size
        if (times + 1) * width > self.capacity:
            raise ValueError(
                f"a replay capacity of {self.capacity} cannot take {times} steps of {width} "
                f"environments; it has to hold {(times + 1) * width}: raise replay_capacity or "
                "lower num_envs"
            )
        slots = (self._cursor + torch.arange(times * width)) % self.capacity
        steps = steps.reshape(-1)
        outcome = steps["next"].select("reward", "done", "terminated")
        rows = store_maps(self.codecs, steps).update({"action": steps["action"], **outcome})
        self._write(slots, rows)
        self._cursor = (self._cursor + times * width) % self.capacity
        self._size = min(self._size + times * width, self.capacity)
        terminated = outcome["terminated"].reshape(-1).cpu()
        self._next_slot[slots] = torch.where(terminated, slots, -1)
        self._link(slots, steps, width)
        self._usable = (self._next_slot >= 0).nonzero().squeeze(-1)

    def _write(self, slots: Tensor, rows: TensorDictBase) -> None:
        if self._frames is None:
            # pages that no frame has reached take no memory yet
            self._frames = rows[0].apply(
                lambda row: row.new_empty(self.capacity, *row.shape),
                batch_size=[self.capacity],
                device=self.device,
            )
        self._frames[slots.to(self.device)] = rows.to(self.device)

    def _link(self, slots: Tensor, steps: TensorDictBase, width: int) -> None:
        """Points each step to the one after it, where that one begins with what this one led to."""
        keys = [codec.key for codec in self.codecs]
        seen, led_to = steps.select(*keys), steps["next"].select(*keys)
        tail = self._tail
        if tail is not None and len(tail["slot"]) == width:
            continues = _same_maps(tail["maps"], seen[:width], keys)
            self._next_slot[tail["slot"][continues]] = slots[:width][continues]
        continues = _same_maps(led_to[:-width], seen[width:], keys)
        self._next_slot[slots[:-width][continues]] = slots[width:][continues]
        self._tail = {"slot": slots[-width:].clone(), "maps": led_to[-width:].clone()}

    def sample(self) -> TensorDictBase:
        """Returns `batch_size` transitions, uniform with replacement, maps packed.

        `("next", "reward")` is the discounted sum of the rewards on the way to `next`, and
        `steps_to_next_obs` `[batch_size, 1]` how many steps that are, as TorchRL's value estimators
        read it.

        Raises:
            RuntimeError: if no transition is complete yet.
        """
        if self._frames is None or not len(self._usable):
            raise RuntimeError("nothing to sample: extend the replay memory by two steps first")
        first = self._usable[torch.randint(len(self._usable), (self.batch_size,))]
        last, reward, steps = self._look_ahead(self._frames["reward"], first)
        following = self._next_slot[last].to(self.device)
        first, last = first.to(self.device), last.to(self.device)
        batch = TensorDict({}, [self.batch_size])
        batch["action"] = self._frames["action"].index_select(0, first)
        for codec in self.codecs:
            batch[codec.key] = self._frames[codec.key].index_select(0, first)
            batch["next", codec.key] = self._frames[codec.key].index_select(0, following)
        batch["next", "reward"] = reward
        for name in ("done", "terminated"):
            batch["next", name] = self._frames[name].index_select(0, last)
        batch["steps_to_next_obs"] = steps.to(self.device)
        return batch

    def _look_ahead(self, rewards: Tensor, first: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns where transitions that begin in slots `first` [N] end.

        Returns:
            The slots of their last steps [N], the discounted sums of `rewards` [N, 1], and how many
            steps they span [N, 1].
        """
        last, steps = first, torch.ones(len(first), 1)
        reward = rewards.index_select(0, first.to(self.device))
        for _ in range(self.n_steps - 1):
            ahead = self._next_slot[last]
            # a terminal step is its own successor, and one without a successor can't be the last
            goes_on = (ahead != last) & (self._next_slot[ahead] >= 0)
            last = torch.where(goes_on, ahead, last)
            weight = (self.gamma**steps * goes_on[:, None]).to(self.device)
            reward = reward + weight * rewards.index_select(0, last.to(self.device))
            steps = steps + goes_on[:, None]
        return last, reward, steps

    def state_dict(self) -> dict[str, Any]:
        """Returns everything that sampling and extending depend on, tensors uncopied."""
        frames = None if self._frames is None else self._frames[: self._size]
        return {
            "capacity": self.capacity,
            "cursor": self._cursor,
            "size": self._size,
            "next_slot": self._next_slot,
            "frames": None if frames is None else frames.to_dict(),
            "tail": self._tail and {**self._tail, "maps": self._tail["maps"].to_dict()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state_dict`.

        Raises:
            ValueError: if it was taken from a memory of another capacity.
        """
        if state["capacity"] != self.capacity:
            raise ValueError(
                f"the saved replay memory has capacity {state['capacity']}, this one "
                f"{self.capacity}; set replay_capacity={state['capacity']}"
            )
        self._cursor, self._size = state["cursor"], state["size"]
        self._next_slot = state["next_slot"].clone()
        self._frames, self._tail = None, None
        if state["frames"] is not None:
            frames = TensorDict(state["frames"], [self._size])
            self._write(torch.arange(self._size), frames)
        if state["tail"] is not None:
            slots = state["tail"]["slot"]
            maps = TensorDict(state["tail"]["maps"], [len(slots)])
            self._tail = {"slot": slots.clone(), "maps": maps.clone()}
        self._usable = (self._next_slot >= 0).nonzero().squeeze(-1)


def time_first(frames: TensorDictBase) -> TensorDictBase:
    """Returns the frames as `[T, N]`."""
    names = list(frames.names)
    time = names.index("time") if "time" in names else None
    if time is None and frames.ndim < 2:
        return frames.reshape(1, -1)
    time = frames.ndim - 1 if time is None else time
    frames = frames.permute(time, *[dim for dim in range(frames.ndim) if dim != time])
    return frames.reshape(frames.shape[0], -1)


def _same_maps(a: TensorDictBase, b: TensorDictBase, keys: Sequence[NestedKey]) -> Tensor:
    """Returns which of N observations are equal in value, as `[N]` on the CPU.

    nan equals nan, and -0.0 equals 0.0: whoever copies a map may lose the sign of a zero, as
    `TensorDict.clone` does where it adds 0.
    """
    pairs = ((a[key].to(b[key].device), b[key]) for key in keys)
    same = [_equal(x, y).flatten(1).all(1) for x, y in pairs]
    return torch.stack(same).all(0).cpu()


def _equal(x: Tensor, y: Tensor) -> Tensor:
    equal = x == y
    return equal | (x.isnan() & y.isnan()) if x.is_floating_point() else equal
