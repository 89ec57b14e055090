"""Description of a discrete action space, read from its spec."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torchrl.data import Categorical, OneHot, TensorSpec
from torchrl.modules import OneHotCategorical


@dataclass(frozen=True)
class DiscreteActions:
    """The number of actions, TorchRL's name for their encoding and the matching distribution."""

    count: int
    space: str
    distribution: type[torch.distributions.Distribution]

    @classmethod
    def from_spec(cls, spec: TensorSpec) -> DiscreteActions:
        """Reads a `Categorical` or `OneHot` spec.

        Raises:
            TypeError: if the spec is of any other type.
        """
        if type(spec) is Categorical:  # its subclasses encode several choices at once
            return cls(int(spec.space.n), "categorical", torch.distributions.Categorical)
        if type(spec) is OneHot:
            return cls(int(spec.space.n), "one-hot", OneHotCategorical)
        raise TypeError(
            f"discrete SAC needs a Categorical or OneHot action spec, got {type(spec).__name__}"
        )
