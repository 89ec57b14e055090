"""Base class of transforms whose outputs depend on the step before."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.data import Composite

from flowrep.transforms.base import MapTransform, MissingKey, flags_of_batch


class RecurrentTransform(MapTransform):
    """Reads the step before from the TensorDict passed to `step`, and keeps no state itself.

    The env declares the `carried_keys` as part of its state, so that episodes and envs can't mix.
    `compute` returns the outputs at an episode's first frame, `advance` those of any other. In an
    env that resets itself within a step (TorchRL's native auto-reset), the next frame of an env
    that is done is a first one, for the transforms that follow too.
    """

    @property
    @abstractmethod
    def carried_keys(self) -> list[NestedKey]:
        """The entries of the step before that `advance` needs."""

    @abstractmethod
    def advance(self, before: Sequence[Tensor], now: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Returns the outputs of a step from the carried entries and the current inputs."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        now = self._read(next_tensordict)
        before = [tensordict.get(key, None) for key in self.carried_keys]
        for key, value in zip(self.carried_keys, before):
            if value is None:
                raise MissingKey(
                    f"representation {self.label} needs {key!r} of the previous step: pass step "
                    f"the TensorDict of reset or step_mdp, which holds {key!r}"
                )
        for key, value in zip(self.out_keys, self.advance(before, now)):
            next_tensordict.set(key, value)
        env = self.parent
        if env is not None and env.__dict__.get("_torchrl_native_autoreset", False):
            self.begin_anew(next_tensordict.get("done"), next_tensordict)
        return next_tensordict

    def begin_anew(self, begins: Tensor, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the outputs of envs that have just begun an episode by those of a first frame.

        Args:
            begins: bool `[*B]` or `[*B, 1]`.
            tensordict: `[*B]`, with the inputs and the outputs.
        """
        begins = flags_of_batch(begins, tensordict)
        for key, first in zip(self.out_keys, self.compute(*self._read(tensordict))):
            mask = expand_as_right(begins, first)
            tensordict.set(key, torch.where(mask, first, tensordict.get(key)))
        return tensordict

    def _trajectory(self, tensordict: TensorDictBase, key: NestedKey) -> tuple[Tensor, int]:
        """Returns `done` `[*B]` of a trajectory that lacks `key`, and which dimension is time."""
        done = tensordict.get(("next", "done"), None)
        if done is None or "time" not in tensordict.names:
            raise MissingKey(
                f"{key!r} is not in the batch, and the step before can't be told: store {key!r}, "
                f"or give a trajectory with ('next', 'done') and a dimension named 'time' "
                f"(td.refine_names(..., 'time')); names are {tensordict.names}"
            )
        return flags_of_batch(done, tensordict), tensordict.names.index("time")

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Returns the input specs of `step`, including the carried entries."""
        input_spec = super().transform_input_spec(input_spec)
        if self.parent is None:
            return input_spec
        observation_spec = self.transform_observation_spec(self.parent.observation_spec)
        for key in self.carried_keys:
            input_spec["full_state_spec"][key] = observation_spec[key].clone()
        return input_spec
