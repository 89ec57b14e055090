"""Random numbers that depend only on a frame's name, not on any other draw.

SplitMix64 (Steele, Lea and Flood 2014) gives direct access to the n-th number of a stream, so a
batch is computed at once and no generator state has to be saved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

# SplitMix64's constants as signed integers, torch's only 64-bit type; products wrap around.
_GAMMA, _FIRST, _SECOND = (
    number - (1 << 64) for number in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)
_DIGITS = 24  # of a float32; `normal` and `uniform` use 24 bits of a number each


def split_mix(state: Tensor) -> Tensor:
    """Returns the number that SplitMix64 generates from a state, element by element.

    Args:
        state: int64; the next state is this plus the generator's gamma.

    >>> split_mix(torch.tensor([1234567]))
    tensor([6457827717110365317])
    """
    z = state + _GAMMA
    for places, factor in ((30, _FIRST), (27, _SECOND)):
        z ^= _shifted(z, places)
        z *= factor
    z ^= _shifted(z, 31)
    return z


def frame_bits(frame: Tensor, shape: Sequence[int], *, seed: int, stream: int) -> Tensor:
    """Returns 64 random bits for each element of a frame, int64 `[*B, *shape]`.

    Args:
        frame: integers `[*B, N]` that name a frame.
        shape: shape of the elements of one frame.
        seed: a different seed gives different numbers for all frames.
        stream: a small number that distinguishes the uses of one frame's numbers.
    """
    start = torch.full_like(frame[..., 0], seed, dtype=torch.int64)
    for number in (torch.full_like(start, stream), *frame.long().unbind(-1)):
        start = split_mix(start) ^ number
    start = split_mix(start)
    places = torch.arange(math.prod(shape), device=frame.device)
    numbers = split_mix(start.unsqueeze(-1) + places * _GAMMA)
    return numbers.unflatten(-1, tuple(shape))


def normal(bits: Tensor) -> Tensor:
    """Returns standard normal numbers from the low bits, float32, within 5.5 of 0."""
    # An odd number over 2^24: exact in float32, symmetric about 0, never at an end of (-1, 1).
    odd = 2 * (bits & ((1 << _DIGITS) - 1)) + 1 - (1 << _DIGITS)
    return math.sqrt(2.0) * torch.erfinv(odd.float() * 2.0**-_DIGITS)


def uniform(bits: Tensor) -> Tensor:
    """Returns uniform numbers in [0, 1) from the high bits, float32; `normal` uses others."""
    return _shifted(bits, 64 - _DIGITS).float() * 2.0**-_DIGITS


def _shifted(z: Tensor, places: int) -> Tensor:
    """Returns the bits shifted right and filled with zeros, where torch repeats the sign."""
    moved = z >> places
    moved &= (1 << (64 - places)) - 1
    return moved
