"""Where two nested states differ."""

import numpy as np
import torch
from tensordict import TensorDictBase


def differing(a, b, place=""):
    """Names every leaf in which two nested states differ: in value, type or dtype."""
    if isinstance(a, TensorDictBase):
        a, b = a.to_dict(), b.to_dict()
    if isinstance(a, list | tuple):
        a, b = dict(enumerate(a)), dict(enumerate(b))
    if isinstance(a, dict):
        if a.keys() != b.keys():
            return [f"{place}: {sorted(map(str, a.keys() ^ b.keys()))}"]
        return [d for key in a for d in differing(a[key], b[key], f"{place}/{key}")]
    if isinstance(a, torch.Tensor | np.ndarray):
        equal = torch.equal if isinstance(a, torch.Tensor) else np.array_equal
        return [] if a.dtype == b.dtype and equal(a, b) else [place]
    return [] if type(a) is type(b) and a == b else [place]
