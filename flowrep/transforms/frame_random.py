"""Random numbers that a frame's name decides: the same whatever else is drawn, and when, and where.

SplitMix64 (Steele, Lea and Flood 2014) gives the n-th number of a stream at one go, so that a batch
is computed as a whole and no generator has a state to be kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

# Those of SplitMix64, as the signed integers that torch has; products wrap around.
_GAMMA, _FIRST, _SECOND = (
    number - (1 << 64) for number in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
)
_DIGITS = 24  # of a float32: half of 48 bits of a number each


def split_mix(state: Tensor) -> Tensor:
    """Returns the number that follows a state of SplitMix64, element by element.

    Args:
        state: int64; the state after it is larger by the generator's gamma.

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
        shape: of what each frame has.
        seed: another one gives other numbers for all frames.
        stream: a small number, by which one frame's different uses are told apart.
    """
    start = torch.full_like(frame[..., 0], seed, dtype=torch.int64)
    for number in (torch.full_like(start, stream), *frame.long().unbind(-1)):
        start = split_mix(start) ^ number
    start = split_mix(start)
    places = torch.arange(math.prod(shape), device=frame.device)
    numbers = split_mix(start.unsqueeze(-1) + places * _GAMMA)
    return numbers.unflatten(-1, tuple(shape))


def normal(bits: Tensor) -> Tensor:
    """Returns standard normal numbers, float32, within 5.5 of 0, by the low bits."""
    # An odd number over 2^24: exact in float32, symmetric about 0, never at an end of (-1, 1).
    odd = 2 * (bits & ((1 << _DIGITS) - 1)) + 1 - (1 << _DIGITS)
    return math.sqrt(2.0) * torch.erfinv(odd.float() * 2.0**-_DIGITS)


def uniform(bits: Tensor) -> Tensor:
    """Returns uniform numbers in [0, 1), float32, by the high bits: `normal` has others."""
    return _shifted(bits, 64 - _DIGITS).float() * 2.0**-_DIGITS


def _shifted(z: Tensor, places: int) -> Tensor:
    """Returns the bits moved to the right, with zeros on the left: torch repeats the sign."""
    moved = z >> places
    moved &= (1 << (64 - places)) - 1
    return moved
