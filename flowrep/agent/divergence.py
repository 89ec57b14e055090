"""Detects nan and infinite losses without making the device wait for the host."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor


class DivergenceError(ArithmeticError):
    """A loss or another watched metric became nan or infinite; the message names it."""


class DivergenceWatch:
    """Keeps, on the device, the metrics of the first update that diverged.

    Args:
        watched: the metrics that have to be finite.
        others: further metrics to report with them.
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
        """0.0 before the first bad update and 1.0 from then on, on the device."""

    def reset(self, good_updates: int = 0) -> None:
        """Forgets what it has seen, changing its own tensors in place.

        Args:
            good_updates: updates before the next one, for its number in messages.
        """
        self._values.zero_()
        self._good_updates.fill_(good_updates)
        self.is_bad.zero_()

    def look(self, metrics: Mapping[str, Tensor]) -> None:
        """Records an update's metrics, changing its own tensors in place."""
        values = torch.stack([metrics[name].float() for name in self.names])
        self._values.copy_(torch.where(self.is_bad.bool(), self._values, values))
        is_good = self._values[: len(self.watched)].isfinite().all()
        self._good_updates += is_good
        self.is_bad.copy_(~is_good)

    def check(self) -> None:
        """Waits for the device and raises if an update has diverged.

        Raises:
            DivergenceError: if a watched metric is not finite; the message names the first such
                metric and lists all metrics of that update.
        """
        values = dict(zip(self.names, self._values.tolist()))
        bad = [name for name in self.watched if not math.isfinite(values[name])]
        if bad:
            raise DivergenceError(
                f"{bad[0]} became {values[bad[0]]:g} in update {int(self._good_updates) + 1} "
                f"({', '.join(f'{name}={value:g}' for name, value in values.items())})"
            )
