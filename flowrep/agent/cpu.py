"""Settings of the process that make gradient steps on a CPU faster."""

from __future__ import annotations

import ctypes
import platform
import statistics
import time

import torch

# mallopt's parameter numbers, from glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_THRESHOLD_BYTES = 1 << 30

PERIOD = 100  # updates from one comparison to the next
TRIALS = 3  # of each choice in a comparison


def keep_freed_memory() -> bool:
    """Tells glibc to reuse large freed blocks; returns whether this C library is glibc and did.

    Call it once and early, as blocks already allocated are not moved.
    """
    # By default glibc maps every block above a threshold (32 MiB at most) afresh and unmaps it when
    # freed, so the kernel zeroes each activation of a large batch page by page in every update.
    # With both thresholds at 1 GiB the blocks stay in the heap.
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    mallopt.argtypes, mallopt.restype = (ctypes.c_int, ctypes.c_int), ctypes.c_int
    accepted = mallopt(_M_MMAP_THRESHOLD, _THRESHOLD_BYTES)
    return bool(accepted and mallopt(_M_TRIM_THRESHOLD, _THRESHOLD_BYTES))


class FasterThreads:
    """A context that runs updates on one or `most` threads, whichever was faster of late.

    PyTorch splits each operation among its threads, which then wait for the slowest one in a busy
    loop. On idle cores, two take 0.7 times as long as one; if a single other program needs one of
    the cores, twice as long, see docs/performance.md. Only the clock tells: a container may have
    fewer cores than the machine shows, and other programs come and go.

    Sums over threads are rounded differently, so only `most=1` (as with `OMP_NUM_THREADS=1`) gives
    two runs of a seed the same bits.
    """

    def __init__(self, most: int) -> None:
        self.choices = (1, most)
        self.chosen = most
        self._entered = 0
        self._seconds: dict[int, list[float]] = {}

    def __enter__(self) -> None:
        self._outside = torch.get_num_threads()
        turn = self._entered % PERIOD
        self._is_trial = turn < 2 * TRIALS
        torch.set_num_threads(self.choices[turn % 2] if self._is_trial else self.chosen)
        self._entered += 1
        self._start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        if self._is_trial:
            seconds = time.perf_counter() - self._start
            self._seconds.setdefault(torch.get_num_threads(), []).append(seconds)
            if self._entered % PERIOD == 2 * TRIALS:
                medians = {n: statistics.median(found) for n, found in self._seconds.items()}
                self.chosen = min(medians, key=lambda n: medians[n])
                self._seconds.clear()
        torch.set_num_threads(self._outside)
