"""The layers of a network on a CPU, with each batch split among a team of threads.

They compute the same as PyTorch's `conv2d`, `leaky_relu` and `linear`, with float32 gradients for
weights. They also do less work: nothing is cast twice, the weight gradients of strided convolutions
are products over unfolded maps, small enough to stay in a core's cache, and class ids are not
spread out to one-hot maps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import FunctionCtx, once_differentiable

from flowrep.agent.class_convolution import ClassConvolution, one_hot
from flowrep.agent.convolution import Convolution, channel_rows
from flowrep.agent.team import parts, run_tasks

SLOPE = 0.01  # of LeakyReLU below 0
ROWS, FEATURES = 128, 128  # of one task
CACHE_BYTES = 1 << 20  # of a core; the largest map of a task should fit into it

aten = torch.ops.aten


def convolve(
    images: Sequence[Tensor],
    weights: Sequence[Tensor],
    strides: Sequence[int],
    dtype: torch.dtype,
) -> Sequence[Tensor]:
    """Returns the features of several maps: convolutions, LeakyReLU after each, flattened.

    Args:
        images: one per map, `[N, C, h, w]`, channels last in memory: of `dtype`, or of uint8, which
            are class ids and mean their one-hot maps `[N, C * n, h, w]`.
        weights: the first map's `[O, C, k, k]` and `[O]` for each stride, then the next map's; the
            first one for class ids has C * n input channels.
        strides: of the convolutions; 1 for the first.
        dtype: to compute in.

    Returns:
        `[N, rows * columns * O]` per map, rows first, channels last, of `dtype`.
    """
    if all(_is_shared_out(image) and not image.requires_grad for image in images):
        keeps = torch.is_grad_enabled()
        return Convolutions.apply(strides, dtype, keeps, len(images), *images, *weights)
    features = []
    for i, x in enumerate(images):
        layers = iter(weights[2 * len(strides) * i :])
        for stride, weight, bias in zip(strides, layers, layers):
            if _holds_ids(x):
                x = one_hot(x, weight.shape[1] // x.shape[1], dtype)
            x = F.leaky_relu_(Convolution(weight, bias, stride, dtype)(x), SLOPE)
        features.append(x.permute(0, 2, 3, 1).flatten(1))
    return features


def linear(x: Tensor, weight: Tensor, bias: Tensor, rows: int | None = None) -> Tensor:
    """Returns `x Wᵀ + b` for `x` `[N, inputs]`, computed in the dtype of `x`.

    Args:
        x: the input.
        weight: `[outputs, inputs]`, float32.
        bias: `[outputs]`, float32.
        rows: of each product on a CPU, so that a row's result doesn't depend on N, to the last bit:
            libraries choose another order of sums for another number of rows. None for the fastest.
    """
    if not _is_shared_out(x):
        return F.linear(x, weight.to(x.dtype), bias.to(x.dtype))
    if rows is None:
        return Linear.apply(x, weight, bias)
    w, b = weight.to(x.dtype), bias.to(x.dtype)
    blocks = F.pad(x, (0, 0, 0, -len(x) % rows)).split(rows)
    return torch.cat([torch.addmm(b, block, w.t()) for block in blocks])[: len(x)]


def _holds_ids(x: Tensor) -> bool:
    return x.dtype is torch.uint8


def _is_shared_out(x: Tensor) -> bool:
    # an exported program takes batches of any size and has no team of threads
    return x.is_cpu and not torch.compiler.is_exporting()


class Convolutions(torch.autograd.Function):
    """Chains of convolutions, each followed by LeakyReLU, one chain per map.

    `apply(strides, dtype, keeps, maps, *tensors)` takes each map's image `[N, C, h, w]` (channels
    last, without a gradient), then each map's weights `[O, C, k, k]` and biases `[O]` in turn, and
    returns each map's features `[N, rows * columns * O]`, rows first, channels last. With `keeps`,
    the activations that `backward` needs are kept.
    """

    @staticmethod
    def forward(
        ctx: Any,
        strides: Sequence[int],
        dtype: torch.dtype,
        keeps: bool,
        maps: int,
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        """Returns the features of each map."""
        images, weights = tensors[:maps], tensors[maps:]
        size = 2 * len(strides)
        chains = [
            _Chain(image, weights[i * size : (i + 1) * size], strides, dtype)
            for i, image in enumerate(images)
        ]
        run_tasks(task for chain in chains for task in chain.forward_tasks(keeps))
        ctx.chains = chains if keeps else None
        return tuple(chain.features for chain in chains)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Returns the gradients of weights and biases."""
        chains: list[_Chain] = ctx.chains
        run_tasks(task for chain, g in zip(chains, gradients) for task in chain.backward_tasks(g))
        ctx.chains = None
        nothing = [None] * (4 + len(chains))
        return (*nothing, *(g for chain in chains for g in chain.weight_gradients()))


class _Chain:
    """The convolutions of one map."""

    def __init__(
        self,
        image: Tensor,
        weights: Sequence[Tensor],
        strides: Sequence[int],
        dtype: torch.dtype,
    ) -> None:
        self.image = image
        looks_up = _holds_ids(image) and dtype is torch.float32
        # in bfloat16 the products take no longer than look-ups, see docs/performance.md
        spreads = _holds_ids(image) and not looks_up
        self.spread = weights[0].shape[1] // image.shape[1] if spreads else None  # to classes
        self.layers: list[Convolution | ClassConvolution] = [
            ClassConvolution(weights[0], weights[1], image.shape[1])
            if looks_up
            else Convolution(weights[0], weights[1], strides[0], dtype)
        ]
        for stride, weight, bias in zip(strides[1:], weights[2::2], weights[3::2]):
            self.layers.append(Convolution(weight, bias, stride, dtype))
        shapes = []  # rows, columns, channels
        size = tuple(image.shape[2:])
        for layer, bias in zip(self.layers, weights[1::2]):
            size = layer.size_after(*size)
            shapes.append((*size, len(bias)))
        self.last = shapes[-1]
        self.features = image.new_empty(len(image), math.prod(self.last), dtype=dtype)
        largest = max(math.prod(shape) for shape in shapes) * self.features.element_size()
        self.parts = parts(len(image), max(1, CACHE_BYTES // largest))
        self.kept: list[list[Tensor]] = [[]] * len(self.parts)
        self.gradients: list[list[Tensor]] = [[]] * len(self.parts)

    def forward_tasks(self, keeps: bool) -> list[Any]:
        return [partial(self._forward, i, part, keeps) for i, part in enumerate(self.parts)]

    def _forward(self, i: int, part: slice, keeps: bool) -> None:
        x = self.image[part]
        if self.spread is not None:
            x = one_hot(x, self.spread, self.features.dtype)
        kept = [x]
        for layer in self.layers:
            x = F.leaky_relu_(layer(x), SLOPE)
            kept.append(x)
        self.features[part].view(-1, *self.last).copy_(x.permute(0, 2, 3, 1))
        if keeps:
            self.kept[i] = kept

    def backward_tasks(self, gradient: Tensor) -> list[Any]:
        return [partial(self._backward, i, part, gradient) for i, part in enumerate(self.parts)]

    def _backward(self, i: int, part: slice, gradient: Tensor) -> None:
        g = gradient[part].reshape(-1, *self.last).permute(0, 3, 1, 2)
        found: list[Tensor] = []
        for index, layer in reversed(list(enumerate(self.layers))):
            x, y = self.kept[i][index : index + 2]
            g = aten.leaky_relu_backward(g, y, SLOPE, True)
            found = [layer.weight_gradient(g, x), channel_rows(g).sum(0), *found]
            if index and isinstance(layer, Convolution):
                g = layer.input_gradient(g, x)
        self.kept[i], self.gradients[i] = [], found

    def weight_gradients(self) -> list[Tensor]:
        """Returns the sums over all parts, in float32."""
        return [_sum(gradients) for gradients in zip(*self.gradients)]


class Linear(torch.autograd.Function):
    """`apply(x, weight, bias)` returns `x Wᵀ + b` for `x` `[N, inputs]`, in the dtype of `x`."""

    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Returns `[N, outputs]`."""
        w, b = weight.to(x.dtype), bias.to(x.dtype)
        y = x.new_empty(len(x), len(w))
        run_tasks(partial(torch.addmm, b, x[p], w.t(), out=y[p]) for p in parts(len(x), ROWS))
        ctx.save_for_backward(x, w)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor | None, ...]:
        """Returns the gradients of input, weight and bias."""
        x, w = ctx.saved_tensors
        tasks: list[Any] = []
        dx = dw = db = None
        if ctx.needs_input_grad[1]:
            dw = torch.empty_like(w, dtype=torch.float32)
            tasks += [partial(_product, g[:, p].t(), x, dw[p]) for p in parts(len(w), FEATURES)]
        if ctx.needs_input_grad[0]:
            dx = torch.empty_like(x)
            tasks += [partial(_product, g[p], w, dx[p]) for p in parts(len(x), ROWS)]
        run_tasks(tasks)
        if ctx.needs_input_grad[2]:
            db = g.sum(0, dtype=torch.float32)
        return dx, dw, db


def _product(a: Tensor, b: Tensor, out: Tensor) -> None:
    if a.dtype is out.dtype:
        torch.mm(a, b, out=out)
    else:
        out.copy_(a @ b)


def _sum(tensors: Sequence[Tensor]) -> Tensor:
    total = tensors[0].float()
    for tensor in tensors[1:]:
        total = total + tensor
    return total
