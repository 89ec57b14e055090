"""Notices a loss that stopped being a number, without making the device wait for the host."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor


class DivergenceError(ArithmeticError):
    """A loss, or what is logged beside it, became nan or infinite; the message says which."""


class DivergenceWatch:
    """Remembers, on the device, the metrics of the first update that went wrong.

    Args:
        watched: the metrics that have to be finite.
        others: those to tell with them.
        device: where the metrics are.

    >>> watch = DivergenceWatch(["q_loss"], ["entropy"])
    >>> for q_loss in (0.5, float("nan"), 0.25):
    ...     watch.look({"q_loss": torch.tensor(q_loss), "entropy": torch.tensor(1.0)})
    >>> watch.check()
    Traceback (most recent call last):
    flowrep.agent.divergence.DivergenceError: q_loss became nan in update 2 (q_loss=nan, entropy=1)
    """

    def __init__(
        self,
        watched: Sequence[str],
        others: Sequence[str] = (),
        device: torch.device | str = "cpu",
    ) -> None:
        self.watched, self.names = tuple(watched), (*watched, *others)
        self._values = torch.zeros(len(self.names), device=device)
        self._good_updates = torch.zeros((), dtype=torch.long, device=device)
        self.is_bad = torch.zeros((), device=device)
        """1.0 from the first bad update on and 0.0 before it, on the device."""

    def look(self, metrics: Mapping[str, Tensor]) -> None:
        """Takes in an update's metrics; all that it keeps is changed in place."""
        values = torch.stack([metrics[name].float() for name in self.names])
        self._values.copy_(torch.where(self.is_bad.bool(), self._values, values))
        is_good = self._values[: len(self.watched)].isfinite().all()
        self._good_updates += is_good
        self.is_bad.copy_(~is_good)

    def check(self) -> None:
        """Waits for the device and says what went wrong, if anything has.

        Raises:
            DivergenceError: naming the first metric that is not finite, and all of that update's.
        """
        values = dict(zip(self.names, self._values.tolist()))
        bad = [name for name in self.watched if not math.isfinite(values[name])]
        if bad:
            raise DivergenceError(
                f"{bad[0]} became {values[bad[0]]:g} in update {int(self._good_updates) + 1} "
                f"({', '.join(f'{name}={value:g}' for name, value in values.items())})"
            )
