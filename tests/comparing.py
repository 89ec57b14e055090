"""Where two nested states differ.

Without PyTorch, as workers of the tests' envs import this too, and then start in a moment.
"""

import numpy as np


def differing(a, b, place=""):
    """Names every leaf in which two nested states differ: in value, type or dtype."""
    if hasattr(a, "to_dict"):  # a TensorDict
        a, b = a.to_dict(), b.to_dict()
    if isinstance(a, list | tuple):
        a, b = dict(enumerate(a)), dict(enumerate(b))
    if isinstance(a, dict):
        if a.keys() != b.keys():
            return [f"{place}: {sorted(map(str, a.keys() ^ b.keys()))}"]
        return [d for key in a for d in differing(a[key], b[key], f"{place}/{key}")]
    if hasattr(a, "dtype"):
        is_equal = a.equal if hasattr(a, "equal") else lambda b: np.array_equal(a, b)
        return [] if a.dtype == b.dtype and is_equal(b) else [place]
    return [] if type(a) is type(b) and a == b else [place]
