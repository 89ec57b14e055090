"""Convolutions over maps of class ids, which look weights up instead of making one-hot maps.

Over the one-hot maps of n classes, all products of a convolution but one in n are with 0. What is
left is a sum of weights, one for each id under the kernel. They are in a table, in which a row has
the weights of an id for all places of the kernel, so that each id of the input is looked up once.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from flowrep.jit import numba_is_installed

IDS_A_PRODUCT = 1 << 12  # their one-hot rows should fit into a core's cache


def one_hot(ids: Tensor, classes: int, dtype: torch.dtype) -> Tensor:
    """Returns `[N, C * classes, h, w]` of ids `[N, C, h, w]`, channels last in memory.

    Channel c * classes + id is 1 where channel c shows that id. An id that is no class, up to 255,
    is 0 everywhere.
    """
    # looking up rows of the identity is several times faster than comparing ids
    identity = torch.eye(256, classes, device=ids.device, dtype=dtype)
    return F.embedding(ids.permute(0, 2, 3, 1).int(), identity).flatten(-2).permute(0, 3, 1, 2)


class ClassConvolution:
    """A float32 convolution of stride 1 over the one-hot maps of ids, see `one_hot`; on a CPU.

    Args:
        weight: `[O, C * classes, k, l]`, float32.
        bias: `[O]`, float32.
        channels: C, of the ids.
    """

    def __init__(self, weight: Tensor, bias: Tensor, channels: int) -> None:
        self.bias = bias
        self.outputs, _, *self.kernel = weight.shape
        self.channels, self.classes = channels, weight.shape[1] // channels
        by_id = weight.unflatten(1, (channels, self.classes)).permute(1, 2, 3, 4, 0)
        rows = F.pad(by_id.flatten(2), (0, 0, 0, 1))  # zeros for an id that is no class
        self.table = rows.flatten(0, 1)  # [C * (classes + 1), k * l * O]
        self.first_rows = torch.arange(channels, dtype=torch.int32) * (self.classes + 1)

    def size_after(self, rows: int, columns: int) -> tuple[int, int]:
        """Returns the rows and columns of its output."""
        return rows - self.kernel[0] + 1, columns - self.kernel[1] + 1

    def __call__(self, ids: Tensor) -> Tensor:
        """Returns `[N, O, rows, columns]` of ids `[N, C, h, w]`, channels last in memory."""
        of_ids = F.embedding_bag(self._rows(ids), self.table, mode="sum")
        of_ids = of_ids.view(len(ids), *ids.shape[2:], *self.kernel, self.outputs)
        rows, columns = self.size_after(*ids.shape[2:])
        y = self.bias.expand(len(ids), rows, columns, self.outputs).contiguous()
        for i in range(self.kernel[0]):
            for j in range(self.kernel[1]):
                y += of_ids[:, i : i + rows, j : j + columns, i, j]
        return y.permute(0, 3, 1, 2)

    def weight_gradient(self, g: Tensor, ids: Tensor) -> Tensor:
        """Returns the weight's gradient, given the output's gradient `g` and the ids."""
        rows, columns = self.size_after(*ids.shape[2:])
        g = g.permute(0, 2, 3, 1)
        of_ids = torch.zeros(len(ids), *ids.shape[2:], *self.kernel, self.outputs)
        for i in range(self.kernel[0]):
            for j in range(self.kernel[1]):
                of_ids[:, i : i + rows, j : j + columns, i, j] = g
        table = self._table_gradient(self._rows(ids), of_ids.flatten(0, 2).flatten(1))
        by_id = table.view(self.channels, self.classes + 1, *self.kernel, self.outputs)
        return by_id[:, : self.classes].permute(4, 0, 1, 2, 3).flatten(1, 2)

    def _rows(self, ids: Tensor) -> Tensor:
        """Returns the row of the table for each id, `[N * h * w, C]`."""
        within = ids.permute(0, 2, 3, 1).reshape(-1, self.channels).int()
        return within.clamp_(max=self.classes).add_(self.first_rows)

    def _table_gradient(self, rows: Tensor, g: Tensor) -> Tensor:
        """Returns the table's gradient: for each of its rows, the sum of `g` where it was read."""
        gradient = torch.zeros_like(self.table)
        if numba_is_installed():
            from flowrep.agent.class_kernel import add_rows

            add_rows(rows.numpy(), g.numpy(), gradient.numpy())
            return gradient
        step = max(1, IDS_A_PRODUCT // self.channels)
        for start in range(0, len(rows), step):
            read = torch.zeros(len(rows[start : start + step]), len(gradient))
            read.scatter_(1, rows[start : start + step].long(), 1.0)
            gradient.addmm_(read.t(), g[start : start + step])
        return gradient
