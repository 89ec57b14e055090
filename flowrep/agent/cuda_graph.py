"""A gradient step as one CUDA graph, so that the device waits for no Python between kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule

Step = Callable[[TensorDictBase], TensorDictBase]

WARM_UP = 3  # steps taken as they are, in which Adam's moments and TorchRL's caches come to be


def as_cuda_graph(step: Step, device: torch.device) -> Step:
    """Returns what does the same as `step`, on a CUDA device from its fourth call on as a graph.

    The graph runs the same kernels on the same memory again and again: `step` may depend on what
    changes between two calls only through its argument and through tensors that are changed in
    place; it asks the device for no number, and brings none to it. On any other device `step`
    itself is returned.

    Args:
        step: takes and returns a TensorDict; on CUDA every one has the first one's keys, shapes and
            dtypes, and ValueError is raised for another.
        device: where it computes.
    """
    if device.type != "cuda":
        return step
    return OfOneShape(CudaGraphModule(step, warmup=WARM_UP, in_keys=[], out_keys=[], device=device))


class OfOneShape:
    """Passes batches on to `step`, and refuses those that are laid out unlike the first.

    A graph copies each batch into the first one's memory, where a batch of one row would be spread
    over all rows, numbers cast and a missing map left as it was, all in silence.
    """

    def __init__(self, step: Step) -> None:
        self.step = step
        self._expected: dict[Any, tuple[Any, ...]] | None = None

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns what `step` does.

        Raises:
            ValueError: naming the first entry that differs.
        """
        layout = {
            key: (tuple(value.shape), value.dtype)
            for key, value in batch.items(include_nested=True, leaves_only=True)
        }
        if self._expected is None:
            self._expected = layout
        # a loss may leave something of its own in a batch that then comes again
        for key, expected in self._expected.items():
            if layout.get(key) != expected:
                raise ValueError(
                    f"the update is a CUDA graph of batches with {key!r} {expected}, this one has "
                    f"it {layout.get(key, 'absent')}: keep batches alike, or call step_eagerly() "
                    "on the algorithm"
                )
        return self.step(batch)
