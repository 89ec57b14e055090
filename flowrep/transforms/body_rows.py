"""Rows of `world_from_body` for bodies that come and go."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

import torch
from torch import Tensor


class BodyRows:
    """Gives each body a row of its own while it is there, in worlds where bodies come and go.

    `InstanceMotion` compares row i of this step's poses with row i of the previous step's, so a row
    must stay with its body, and must be empty for a step before another body takes it. Rows of
    absent bodies hold nan: their flow is unknown, not a jump.

    Args:
        count: the number of rows: bodies there at once, and those that have just left.

    Example:
        >>> import torch
        >>> rows = BodyRows(3)
        >>> imp, demon = torch.eye(4), torch.eye(4)
        >>> rows({"imp": imp, "demon": demon})[:, 0, 0]
        tensor([1., 1., nan], dtype=torch.float64)
        >>> rows({"demon": demon, "cacodemon": imp})[:, 0, 0]  # the imp's row stays empty first
        tensor([nan, 1., 1.], dtype=torch.float64)
        >>> labels = torch.tensor([[[0, 9, 5]]])
        >>> rows.instance(labels, {9: "demon", 5: "cacodemon"})
        tensor([[[0, 2, 3]]])
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self.clear()

    def clear(self) -> None:
        """Forgets all bodies; to be called at a reset."""
        self._row_of: dict[Hashable, int] = {}

    def __call__(self, poses: Mapping[Hashable, Tensor]) -> Tensor:
        """Returns the poses `[count, 4, 4]`, float64, of this step's bodies by id.

        Raises:
            ValueError: there are more bodies than free rows.
        """
        free = sorted(set(range(self.count)) - set(self._row_of.values()))
        arrived = [body for body in poses if body not in self._row_of]
        if len(arrived) > len(free):
            raise ValueError(
                f"{len(arrived)} bodies arrive and {len(free)} of {self.count} rows are free: "
                f"use BodyRows({self.count + len(arrived) - len(free)}) or more"
            )
        self._row_of = {body: row for body, row in self._row_of.items() if body in poses}
        self._row_of |= dict(zip(arrived, free))
        out = torch.full((self.count, 4, 4), torch.nan, dtype=torch.float64)
        for body, row in self._row_of.items():
            out[row] = torch.as_tensor(poses[body])
        return out

    def instance(self, labels: Tensor, body_of: Mapping[int, Hashable]) -> Tensor:
        """Returns `("sensor", "instance")`: 1 + the row of each pixel's body, 0 without one.

        Args:
            labels: a label per pixel, any shape; an integer type.
            body_of: the bodies' ids by label, of this step. Labels may change every step.
        """
        out = torch.zeros_like(labels)
        for label, body in body_of.items():
            if body in self._row_of:
                out[labels == label] = 1 + self._row_of[body]
        return out
