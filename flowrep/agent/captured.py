"""A gradient step as one CUDA graph, so that the device waits for no Python between kernels."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule

Step = Callable[[TensorDictBase], TensorDictBase]

WARM_UP = 3  # steps taken as they are, in which Adam's moments and TorchRL's caches come to be


def captured(step: Step, device: torch.device) -> Step:
    """Returns what does the same as `step`, on a CUDA device from its fourth call on as a graph.

    The graph runs the same kernels on the same memory again and again: `step` may depend on what
    changes between two calls only through its argument and through tensors that are changed in
    place; it asks the device for no number, and brings none to it. Every argument has the shapes of
    the first. On any other device `step` itself is returned.

    Args:
        step: takes and returns a TensorDict.
        device: where it computes.
    """
    if device.type != "cuda":
        return step
    return CudaGraphModule(step, warmup=WARM_UP, in_keys=[], out_keys=[], device=device)
