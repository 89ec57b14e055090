"""Convolutions of part of a batch, with the gradients of weights as products in a core's cache."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

aten = torch.ops.aten


class Convolution:
    """A convolution without padding.

    Args:
        weight: `[O, C, k, l]`, float32.
        bias: `[O]`, float32.
        stride: of both axes.
        dtype: to compute in.
    """

    def __init__(self, weight: Tensor, bias: Tensor, stride: int, dtype: torch.dtype) -> None:
        # channels-last weights keep a whole chain in that layout
        self.weight = weight.to(dtype, memory_format=torch.channels_last)
        self.bias, self.stride = bias.to(dtype), stride

    def size_after(self, rows: int, columns: int) -> tuple[int, int]:
        """Returns the rows and columns of its output."""
        height, width = self.weight.shape[2:]
        return (rows - height) // self.stride + 1, (columns - width) // self.stride + 1

    def __call__(self, x: Tensor) -> Tensor:
        """Returns `[N, O, rows, columns]` of `x` `[N, C, h, w]`, channels last in memory."""
        return F.conv2d(x, self.weight, self.bias, self.stride)

    def weight_gradient(self, g: Tensor, x: Tensor) -> Tensor:
        """Returns the weight's gradient, given the output's gradient `g` and the input `x`."""
        outputs, channels, height, width = self.weight.shape
        if height * width < 9:  # unfolding costs more than it saves
            return self._backward(g, x, [False, True])[1]
        product = channel_rows(g).t() @ _unfold(x, height, width, self.stride)
        return product.view(outputs, height, width, channels).permute(0, 3, 1, 2)

    def input_gradient(self, g: Tensor, x: Tensor) -> Tensor:
        """Returns the input's gradient, given the output's gradient `g` and the input `x`."""
        return self._backward(g, x, [True, False])[0]

    def _backward(self, g: Tensor, x: Tensor, wanted: list[bool]) -> tuple[Tensor, ...]:
        return aten.convolution_backward(
            g, x, self.weight, None,
            [self.stride] * 2, [0, 0], [1, 1],  # stride, padding, dilation
            False, [0, 0], 1,  # transposed, output padding, groups
            [*wanted, False],
        )  # fmt: skip


def channel_rows(x: Tensor) -> Tensor:
    """Returns `[N, C, h, w]` as `[N * h * w, C]`."""
    return x.permute(0, 2, 3, 1).reshape(-1, x.shape[1])


def _unfold(x: Tensor, height: int, width: int, stride: int) -> Tensor:
    """Returns the window of each output pixel: `[N * rows * columns, height * width * C]`."""
    x = x.permute(0, 2, 3, 1)
    windows = x.unfold(1, height, stride).unfold(2, width, stride)  # [N, rows, columns, C, h, w]
    return windows.permute(0, 1, 2, 4, 5, 3).reshape(-1, height * width * x.shape[-1])
