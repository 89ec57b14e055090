"""Notices on the device that an update has diverged, and says so when it is asked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor


class DivergenceError(ArithmeticError):
    """A loss or another watched metric became nan or infinite; the message names it."""


class DivergenceWatch:
    """Keeps, on the device, the metrics of the first update in which a `watched` one isn't finite.

    Its tensors change in place, so that it works within a CUDA graph.
    """

    def __init__(
        self, watched: Sequence[str], others: Sequence[str] = (), device: torch.device | str = "cpu"
    ) -> None:
        self.watched, self.names = tuple(watched), (*watched, *others)
        self._values = torch.zeros(len(self.names), device=device)
        self._good_updates = torch.zeros((), dtype=torch.long, device=device)
        self.is_bad = torch.zeros((), device=device)  # 1.0 from the first bad update on

    def reset(self, good_updates: int = 0) -> None:
        """Forgets all metrics; `good_updates` is the number of updates so far."""
        self._values.zero_()
        self._good_updates.fill_(good_updates)
        self.is_bad.zero_()

    def record(self, metrics: Mapping[str, Tensor]) -> None:
        """Records an update's metrics, unless an earlier one was bad."""
        values = torch.stack([metrics[name].float() for name in self.names])
        self._values.copy_(torch.where(self.is_bad.bool(), self._values, values))
        is_good = self._values[: len(self.watched)].isfinite().all()
        self._good_updates += is_good
        self.is_bad.copy_(~is_good)

    def check(self) -> None:
        """Waits for the device and raises a `DivergenceError` if an update has diverged."""
        values = dict(zip(self.names, self._values.tolist()))
        bad = [name for name in self.watched if not math.isfinite(values[name])]
        if bad:
            raise DivergenceError(
                f"{bad[0]} became {values[bad[0]]:g} in update {int(self._good_updates) + 1} "
                f"({', '.join(f'{name}={value:g}' for name, value in values.items())})"
            )
