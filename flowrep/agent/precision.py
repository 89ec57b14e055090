"""The dtype that the networks compute in. Weights, losses and optimizer stay in float32."""

from __future__ import annotations

import torch

PRECISIONS = ("auto", "bf16", "fp32")


def compute_dtype(precision: str, device: torch.device) -> torch.dtype:
    """Returns the dtype of activations for `precision` on `device`.

    Args:
        precision: `"bf16"`, `"fp32"`, or `"auto"`: bfloat16 where the device multiplies it faster
            than float32, float32 elsewhere.
        device: where the networks run.

    Raises:
        ValueError: on any other `precision`.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision={precision!r}: expected one of {', '.join(PRECISIONS)}")
    if precision == "auto":
        return torch.bfloat16 if has_fast_bf16(device) else torch.float32
    return torch.bfloat16 if precision == "bf16" else torch.float32


def has_fast_bf16(device: torch.device) -> bool:
    """Returns whether `device` has instructions for bfloat16 products (AVX-512 BF16, AMX, CUDA)."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "cpu":
        instructions = torch.cpu.get_capabilities()
        return bool(instructions.get("avx512_bf16") or instructions.get("amx_bf16"))
    return False
