"""How PyTorch uses a CPU: its threads, and memory that it keeps."""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Iterator
from contextlib import contextmanager

import torch

# mallopt's parameter numbers, from glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_THRESHOLD_BYTES = 1 << 30


def keep_freed_memory() -> bool:
    """Makes glibc reuse large freed blocks; returns whether that worked (False without glibc).

    Call it once and early, because it doesn't affect blocks that are already allocated.
    """
    # By default, glibc maps every block above a threshold (32 MiB at most) and unmaps it when
    # freed, so the kernel zeroes each activation of a large batch page by page in every update.
    # With both thresholds at 1 GiB, the blocks stay in the heap.
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    mallopt.argtypes, mallopt.restype = (ctypes.c_int, ctypes.c_int), ctypes.c_int
    accepted = mallopt(_M_MMAP_THRESHOLD, _THRESHOLD_BYTES)
    return bool(accepted and mallopt(_M_TRIM_THRESHOLD, _THRESHOLD_BYTES))


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Makes PyTorch use `count` threads inside the context.

    The number of threads changes how sums are rounded, so only the same number gives the same bits.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
