"""Runs a gradient step as one CUDA graph, without waiting for Python between kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule

Step = Callable[[TensorDictBase], TensorDictBase]

WARM_UP = 3  # eager steps, which create Adam's moments and TorchRL's caches


def as_cuda_graph(step: Step, device: torch.device) -> Step:
    """Returns an equivalent of `step` that runs as a CUDA graph from its fourth call on.

    The graph replays the same kernels on the same memory. Values that change between calls must
    therefore reach `step` through its argument or through tensors changed in place, and `step`
    must not copy numbers between host and device. On any device but CUDA, `step` itself is
    returned.

    Args:
        step: takes and returns a TensorDict. On CUDA, a batch whose keys, shapes or dtypes differ
            from the first one's raises ValueError.
        device: where `step` computes.
    """
    if device.type != "cuda":
        return step
    return OfOneShape(CudaGraphModule(step, warmup=WARM_UP, in_keys=[], out_keys=[], device=device))


class OfOneShape:
    """Passes batches on to `step` and rejects those whose layout differs from the first one's.

    A graph copies each batch into the first one's memory. Without the check, a batch of one row
    would silently be broadcast, numbers be cast and a missing map keep its old values.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        self._expected: dict[Any, tuple[Any, ...]] | None = None

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns `step(batch)`.

        Raises:
            ValueError: if an entry differs from the first batch's; the message names it.
        """
        layout = {
            key: (tuple(value.shape), value.dtype)
            for key, value in batch.items(include_nested=True, leaves_only=True)
        }
        if self._expected is None:
            self._expected = layout
        # only the first batch's keys count: a loss may add its own to a batch that is reused
        for key, expected in self._expected.items():
            if layout.get(key) != expected:
                raise ValueError(
                    f"the update is a CUDA graph of batches with {key!r} {expected}, this one has "
                    f"it {layout.get(key, 'absent')}: keep the layout of batches fixed, or call "
                    "step_eagerly() on the algorithm"
                )
        return self.step(batch)
