"""The latest steps in order, from which an on-policy algorithm learns once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase

from flowrep.agent.observation import MapCodec, store_maps
from flowrep.agent.replay import time_first


class Rollout:
    """Keeps steps of N environments until `clear`, with their packed maps and next maps.

    Args:
        codecs: the maps to keep; see `flowrep.agent.observation`.
        device: where they are kept.
        extra_keys: entries kept besides the maps, `action` and its outcome.
    """

    def __init__(
        self,
        codecs: Sequence[MapCodec],
        device: torch.device | str,
        extra_keys: Sequence[NestedKey] = (),
    ) -> None:
        self.codecs, self.device = tuple(codecs), torch.device(device)
        self._keys = ("action", *extra_keys)
        self._steps: list[TensorDictBase] = []

    def __len__(self) -> int:
        """Returns the number of steps of each environment."""
        return len(self._steps)

    def numel(self) -> int:
        """Returns the number of steps of all environments."""
        return sum(step.numel() for step in self._steps)

    def extend(self, frames: TensorDictBase) -> None:
        """Stores steps of N environments: `[N]`, `[N, T]`, or as a TorchRL collector returns them.

        Args:
            frames: with the maps, `action`, `extra_keys` and, under `next`, the maps, `reward`,
                `done` and `terminated`. A dim named `time` is the time dim; without one, a single
                dim is N.
        """
        for step in time_first(frames).unbind(0):
            kept = store_maps(self.codecs, step).update(step.select(*self._keys).detach())
            outcome = step["next"].select("reward", "done", "terminated")
            kept["next"] = store_maps(self.codecs, step["next"]).update(outcome)
            self._steps.append(kept.to(self.device))

    def steps(self) -> TensorDictBase:
        """Returns all steps as `[N, T]`, the last dim named `time`."""
        steps: TensorDictBase = TensorDict.stack(self._steps, 1)
        steps.names = [None, "time"]
        return steps

    def clear(self) -> None:
        """Forgets all steps."""
        self._steps = []

    def state_dict(self) -> dict[str, Any]:
        """Returns the steps."""
        stacked = TensorDict.stack(self._steps).to_dict() if self._steps else None
        return {"length": len(self._steps), "steps": stacked}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a `state_dict`.

        Raises:
            ValueError: if an entry that this rollout keeps is missing.
        """
        self.clear()
        if state["length"]:
            missing = [key for key in self._keys if key not in state["steps"]]
            if missing:
                raise ValueError(
                    f"the saved rollout lacks {missing[0]!r}: the checkpoint is of an older "
                    "version, start the run anew"
                )
            width = len(state["steps"]["action"][0])
            steps = TensorDict(state["steps"], [state["length"], width]).to(self.device)
            steps["next"].batch_size = steps.batch_size
            self._steps = list(steps.unbind(0))
