"""Numbers by a frame's name: SplitMix64's own, evenly spread, unlike any other frame's."""

from __future__ import annotations

import math

import pytest
import torch

from flowrep.transforms.noise import frame_bits, normal, split_mix, uniform

# The first outputs of the generator's reference implementation for seed 1234567.
REFERENCE = [
    6457827717110365317,
    3203168211198807973,
    9817491932198370423,
    4593380528125082431,
    16408922859458223821,
]
GAMMA = 0x9E3779B97F4A7C15


def test_split_mix_gives_the_numbers_of_its_reference():
    states = [(1234567 + step * GAMMA) % 2**64 for step in range(5)]
    signed = torch.tensor([state - 2**64 * (state >= 2**63) for state in states])
    assert [int(number) % 2**64 for number in split_mix(signed)] == REFERENCE


def test_numbers_of_known_bits_by_hand():
    # Low 24 bits 2^23 - 1 and 2^23 lie 2^-24 below and above 0, where a normal number is
    # sqrt(2 pi) / 2 times as far; all ones is the largest of all.
    bits = torch.tensor([2**23 - 1, 2**23, 2**24 - 1, 0])
    near = math.sqrt(2 * math.pi) / 2 * 2.0**-24
    got = normal(bits).double()
    torch.testing.assert_close(got[:2], torch.tensor([-near, near]).double(), rtol=1e-5, atol=0)
    torch.testing.assert_close(got[2], torch.tensor(5.4199).double(), rtol=1e-3, atol=0)
    assert got[3] == -got[2]
    # The high 24 bits: none, all, and the sign bit alone, which is a half.
    bits = torch.tensor([2**40 - 1, -1, -(2**63)])
    assert uniform(bits).tolist() == [0.0, 1.0 - 2.0**-24, 0.5]


@pytest.fixture(scope="module")
def bits():
    """A million numbers: 100 frames of 100 episodes, 100 of each."""
    episode, step = torch.meshgrid(torch.arange(100), torch.arange(100), indexing="ij")
    return frame_bits(torch.stack([episode, step], -1), (100,), seed=0, stream=0)


def test_normal_and_uniform_numbers_are_spread_as_they_should_be(bits):
    x, u = normal(bits).double().flatten(), uniform(bits).double().flatten()
    million = len(x)  # limits are five standard errors
    assert abs(x.mean()) < 5 / million**0.5
    assert abs(x.var() - 1) < 5 * (2 / million) ** 0.5
    assert abs(x.pow(3).mean()) < 5 * (15 / million) ** 0.5
    assert abs(x.pow(4).mean() - 3) < 5 * (96 / million) ** 0.5
    assert abs(u.mean() - 0.5) < 5 * (1 / 12 / million) ** 0.5
    assert abs(u.var() - 1 / 12) < 5 * (1 / 180 / million) ** 0.5
    steps = torch.linspace(0, 1, million, dtype=torch.float64)
    of_normal = 0.5 * (1 + torch.erf(x.sort().values / math.sqrt(2)))
    for shares in (u.sort().values, of_normal):  # Kolmogorov and Smirnov's distance
        assert (shares - steps).abs().max() < 2.2 / million**0.5
    assert abs((x * (u - 0.5)).mean()) < 5 * (1 / 12 / million) ** 0.5


def test_neighbours_have_nothing_in_common(bits):
    x = normal(bits)  # [episodes, steps, places]
    for dim in range(3):
        for lag in (1, 2, 7):
            pairs = x.narrow(dim, lag, 100 - lag) * x.narrow(dim, 0, 100 - lag)
            assert abs(pairs.mean()) < 5 / pairs.numel() ** 0.5, (dim, lag)
    swapped = x * x.transpose(0, 1)  # (3, 5) and (5, 3); the diagonal is a frame with itself
    assert abs(swapped[~torch.eye(100, dtype=torch.bool)].mean()) < 0.01
    assert len(bits.unique()) == bits.numel()


def test_every_part_of_the_name_counts():
    frame = torch.tensor([[12, 0]])
    same = frame_bits(frame, (50,), seed=3, stream=1)
    assert torch.equal(frame_bits(frame.to(torch.int32), (50,), seed=3, stream=1), same)
    for other in (
        frame_bits(frame, (50,), seed=4, stream=1),
        frame_bits(frame, (50,), seed=3, stream=2),
        frame_bits(torch.tensor([[12, 1]]), (50,), seed=3, stream=1),
        frame_bits(torch.tensor([[0, 12]]), (50,), seed=3, stream=1),
        frame_bits(torch.tensor([[12]]), (50,), seed=3, stream=1),
    ):
        assert not (other == same).any()
