"""The number format of activations: bfloat16 where it is faster than float32."""

from __future__ import annotations

import math
import timeit
from functools import cache, partial

import torch
import torch.nn.functional as F

PRECISIONS = ("auto", "bf16", "fp32")


def compute_dtype(precision: str, device: torch.device) -> torch.dtype:
    """Returns the dtype of activations; weights, losses and optimizer stay in float32.

    `precision` is `"bf16"`, `"fp32"`, or `"auto"`, see `resolved_precision`.
    """
    return {"bf16": torch.bfloat16, "fp32": torch.float32}[resolved_precision(precision, device)]


def resolved_precision(precision: str, device: torch.device) -> str:
    """Returns `"bf16"` or `"fp32"`; for `"auto"` bfloat16 where it is faster than float32.

    On a CPU, this is measured. A run resolves "auto" once and keeps the answer, so that it computes
    the same numbers when it is resumed.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision={precision!r}: expected one of {', '.join(PRECISIONS)}")
    if precision != "auto":
        return precision
    is_faster = has_bf16(device) and (device.type == "cuda" or _bf16_products_are_faster())
    return "bf16" if is_faster else "fp32"


def has_bf16(device: torch.device) -> bool:
    """Returns whether `device` has instructions for bfloat16; others emulate it."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    instructions = torch.cpu.get_capabilities() if device.type == "cpu" else {}
    return bool(instructions.get("avx512_bf16") or instructions.get("amx_bf16"))


@cache
def _bf16_products_are_faster() -> bool:
    # Measured, because AVX-512's dot product of bfloat16 has 2 times the rate of float32 on some
    # processors and 0.6 times on others. Both types are timed in turns and on one thread: the
    # shortest of twenty times hardly depends on what else the machine does.
    least = {torch.bfloat16: math.inf, torch.float32: math.inf}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    for dtype in [*least] * 20:
        x, weight = torch.ones(128, 1024, dtype=dtype), torch.ones(512, 1024, dtype=dtype)
        least[dtype] = min(least[dtype], timeit.timeit(partial(F.linear, x, weight), number=1))
    torch.set_num_threads(threads)
    return least[torch.bfloat16] < least[torch.float32]
