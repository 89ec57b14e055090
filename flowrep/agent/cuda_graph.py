"""Runs an update as one CUDA graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule

Step = Callable[[TensorDictBase], TensorDictBase]
WARM_UP = 3  # eager updates before the graph is captured; they create Adam's moments and caches


def as_cuda_graph(step: Step, device: torch.device) -> Step:
    """Returns an equivalent of `step` that runs as a CUDA graph from its fourth call on.

    The graph replays the same kernels on the same memory. Values that change between calls must
    therefore reach `step` through its argument or through tensors changed in place, and `step`
    must not copy numbers between host and device. On any device but CUDA it is `step` itself.
    """
    if device.type != "cuda":
        return step
    return with_fixed_layout(
        CudaGraphModule(step, warmup=WARM_UP, in_keys=[], out_keys=[], device=device)
    )


def with_fixed_layout(step: Step) -> Step:
    """Returns `step` with a check that each batch has the layout of the first one.

    A graph copies each batch into the memory of the first one. Without the check, a batch of one
    row would silently be broadcast, numbers would be cast, and a missing map would keep its old
    values.
    """
    first: dict[Any, tuple[Any, ...]] = {}

    def checked(batch: TensorDictBase) -> TensorDictBase:
        items = batch.items(include_nested=True, leaves_only=True)
        layout = {key: (tuple(value.shape), value.dtype) for key, value in items}
        first.update(() if first else layout)
        # Compare only the keys of the first batch: a loss may add keys to a batch that is reused.
        for key, expected in first.items():
            if layout.get(key) != expected:
                raise ValueError(
                    f"the update is a CUDA graph of batches with {key!r} {expected}, this one has "
                    f"it {layout.get(key, 'absent')}: keep the layout of batches fixed, or call "
                    "step_eagerly() on the algorithm"
                )
        return step(batch)

    return checked
