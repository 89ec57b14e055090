"""A mistake's numbers, fitted to pairs of frames."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from flowrep.diagnosis.fit import Pairs, gauss_newton, residuals
from flowrep.diagnosis.mistakes import Mistake

# A fitted factor beyond these, or below their inverse, is no camera's and no unit's.
_LARGEST_FACTORS = {"camera": 30.0, "depth": 1e5}


class Candidate(NamedTuple):
    """A mistake with its numbers `[P, k]`, and the pairs as it changes them.

    `misfit` is the cost of the residuals, and `surprise` that of the numbers by their prior, nats.
    """

    mistake: Mistake
    n: Tensor
    pairs: Pairs
    misfit: float = 0.0
    surprise: float = 0.0


def candidate(pairs: Pairs, mistake: Mistake, motion: Tensor, noise: Tensor) -> Candidate | None:
    """Returns a mistake with numbers that were fitted to the other half of the pairs.

    Of fewer than four pairs, all share a number. None if there are too few pairs, or if a factor is
    too large or too small.

    Args:
        motion: the recorded motions `[P, 4, 4]`, or those of the pictures in their place.
        noise: standard deviations of residuals `[P, N]`, px.
    """
    count, k, few = len(noise), len(mistake.start[0]), pairs.few
    noise = noise[:, : few.depth.shape[1]]
    if count < 4 and k > 1:
        return None
    is_of_poses = (mistake.subject == "poses" or mistake.changes_poses) and few.has_poses

    def residuals_of(n: Tensor) -> Tensor:
        changed = [mistake.change(few, each) for each in n]
        return torch.stack([residuals(x, x.motion if is_of_poses else motion) for x in changed])

    def cost(n: Tensor) -> float:
        squared = (residuals_of(n.unsqueeze(0)) / noise.unsqueeze(1)).square().sum(2)
        # Depth that is looked up elsewhere, or the next pose, is unknown at some pixels or pairs:
        # they count as others do.
        return float(squared.log1p().nanmean(-1).nanmean().nan_to_num(math.inf))

    starts = [noise.new_tensor(start).expand(count, k) for start in mistake.start]
    if not k:
        return Candidate(mistake, starts[0], mistake.change(pairs, starts[0]), cost(starts[0]))
    every = torch.arange(count)
    half = every % 2 if count >= 4 else 0 * every
    group = every if mistake.per_pair else half
    start, spread = min(starts, key=cost)[0], noise.new_tensor(mistake.spread)

    def numbers(m: Tensor) -> Tensor:
        """Factors are fitted as their logarithms."""
        return torch.where(start != 0, start * (spread * m).exp(), spread * m)

    m = noise.new_zeros(int(group.max()) + 1, k)
    m, _ = gauss_newton(lambda m: residuals_of(numbers(m)), m, group, noise, steps=5)
    n = numbers(m)
    if mistake.per_pair:
        # A frame's number is taken from the fit to the other pair that has this frame.
        follows, own = pairs.follows, n
        if not follows.any():
            return None
        n = n.clone()
        n[:-1, 0] = torch.where(follows, own[1:, 1], own[:-1, 0])
        n[1:, 1] = torch.where(follows, own[:-1, 0], own[1:, 1])
    else:
        n = n[half.max() - half]
    if mistake.in_pixels:
        n = (n * pairs.now.shape[-1]).round() / pairs.now.shape[-1]
    first, most = n.new_tensor(mistake.start[0]), _LARGEST_FACTORS.get(mistake.subject, math.inf)
    factors = n[:, first != 0] / first[first != 0]
    if not bool(((factors > 1 / most) & (factors < most)).all()):
        return None
    surprise = float(m.square().sum(-1).mean() / 2)
    return Candidate(mistake, n, mistake.change(pairs, n), cost(n), surprise)
