"""What data leave, as they are and as each rival corrects them, and whether that is noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from flowrep.diagnosis.rivals import Rival
from flowrep.diagnosis.witness import (
    EYE,
    FITTED,
    Pairs,
    apart,
    best_motion,
    descended,
    least_costly,
    median,
    motion_vector,
    px_of,
    residual,
    scale_of,
    small_motion,
)  # fmt: skip

# No error: rounding, a share of the noise, and of flow that was estimated, which is too short.
EXACT_PX, _OF_NOISE, _OF_ESTIMATED = 2e-3, 0.3, 0.03
# What explains an error leaves several times less, or clearly less in most of many pairs.
SEVERAL, CLEARLY, _MANY_PAIRS = 3.0, 1.7, 8
_STRUCTURED = 0.1  # of raw flow: more structure than an estimator's own
_AS_IT_IS = Rival("poses", "", "", lambda pairs, n: pairs)
_LARGEST_FACTORS = {"camera": 30.0, "depth": 1e5}


class Found(NamedTuple):
    """What the data leave, as they are or as a rival corrects them, px `[P]`.

    `error` is what the recorded motion leaves beyond the best one, `spread` what that leaves.
    """

    rival: Rival
    n: Tensor  # [k]
    pairs: Pairs
    motion: Tensor  # the best
    error: Tensor
    spread: Tensor

    def beyond(self, noise: Tensor) -> Tensor:
        """Returns what is left beyond noise."""
        return (self.error.square() + (self.spread.square() - noise.square()).clamp(min=0)).sqrt()

    @property
    def left(self) -> float:
        """The median of all that is left."""
        return median(self.beyond(torch.zeros_like(self.spread)))

    @property
    def least(self) -> float:
        """The error below which there is none."""
        pairs = self.pairs
        bias = _OF_ESTIMATED * median(px_of(pairs.raw)) if pairs.is_estimated else 0.0
        return max(self.floor, bias)

    @property
    def floor(self) -> float:
        """The error below which errors are alike, by how far two halves of the picture differ.

        The halves are every other block of it, since neighbouring pixels err alike.
        """
        pairs, (height, width) = self.pairs, self.pairs.now.shape[-2:]
        block = pairs.place.nan_to_num() / torch.tensor([[width / 6], [height / 4]])
        is_even = block.floor().sum(1) % 2 == 0
        halves = [
            best_motion(pairs._replace(depth=pairs.depth.masked_fill(half, math.nan)), self.motion)
            for half in (is_even, ~is_even)
        ]
        halves_px = SEVERAL * median(apart(pairs, *halves)) / 2
        return max(EXACT_PX, halves_px, _OF_NOISE * median(self.spread))

    @property
    def is_unexplained(self) -> bool:
        """Whether what is left can be predicted, and so is no noise."""
        least, smooth = self.least, _smoothed(self.pairs, self.motion)
        structure = median((self.spread.square() - smooth.square()).clamp(min=0).sqrt())
        is_large = structure > _STRUCTURED * median(px_of(self.pairs.raw))
        share = median(smooth) / max(median(self.spread), 1e-12)
        if structure > least and (
            share < 1 / SEVERAL or (is_large and is_better(smooth, self.spread))
        ):
            return True
        if len(smooth) < _MANY_PAIRS or not median(self.error) > least:
            return False
        return is_better(_mapped(self.pairs, self.motion), self.error)


def is_better(after: Tensor, before: Tensor) -> bool:
    """Whether errors `[P]` are several times less than others, or clearly less in most pairs."""
    share, better = median(after) / median(before), int((after < before / 1.1).sum())
    # By chance in one of 200 cases: 8 of 8 pairs, 16 of 19.
    by_no_chance = 2 * better - len(after) > 2.6 * len(after) ** 0.5
    return share < 1 / SEVERAL or (share < 1 / CLEARLY and by_no_chance)


def explanations(
    pairs: Pairs, starts: Sequence[Tensor], rivals: Sequence[Rival]
) -> tuple[Found, list[Found]]:
    """Returns what the data leave, and what they leave as each rival that may help corrects them.

    Args:
        starts: motions `[P, 4, 4]` that the best one may be near to.
    """
    few, none, has_poses = pairs.of(pixels=slice(FITTED)), pairs.depth[:, :0], pairs.has_poses
    still = EYE.expand(len(none), 4, 4)
    starts = [*starts, still]
    if has_poses:
        known = [r.change(pairs, none).motion for r in rivals if r.of == "poses" and not r.start[0]]
        known = [pairs.motion, *known]
        starts = [pairs.motion, least_costly(few, torch.stack(known)), *starts]

    def found(rival: Rival, n: Tensor, changed: Pairs, motion: Tensor) -> Found:
        error = apart(changed, changed.motion, motion) if has_poses else none.new_zeros(len(none))
        n = n.nanmedian(0).values
        return Found(rival, n, changed, motion, error, px_of(residual(changed, motion)))

    recorded, others = found(_AS_IT_IS, none, pairs, best_motion(pairs, *starts, steps=8)), []
    if has_poses and recorded.left < EXACT_PX:
        return recorded, []
    left = median(px_of(residual(few, pairs.motion if has_poses else recorded.motion)))
    halves = [(few.of(half), half) for half in _halves(len(none))]
    for rival in rivals:
        if rival.of == "poses" and not has_poses:
            continue
        n = _learnt(few, halves, rival, recorded.motion)
        if n is None:
            continue
        changed, motion = rival.change(pairs, n), recorded.motion
        if rival.of != "poses":
            start = changed.motion if has_poses else still
            # Beside poses, what leaves more than the data do is no explanation.
            if has_poses:
                now_left = px_of(residual(changed.of(pixels=slice(FITTED)), start))
                if not median(now_left) <= left:
                    continue
            motion = best_motion(changed, start, motion)
        others.append(found(rival, n, changed, motion))
    return recorded, others


def _halves(count: int) -> list[Tensor]:
    """Returns every other of the pairs, and the rest; all of them twice if there are few."""
    every = torch.arange(count)
    return [every[::2], every[1::2]] if count >= 4 else [every, every]


def _learnt(
    few: Pairs, halves: Sequence[tuple[Pairs, Tensor]], rival: Rival, best: Tensor
) -> Tensor | None:
    """Returns a rival's numbers [P, k], learnt from the other half of the pairs.

    None if there are too few, or if they are no camera's.
    """
    n, first = torch.zeros(len(best), len(rival.start[0])).double(), torch.tensor(rival.start[0])
    if not n.shape[1]:
        return n
    if len(best) < 4 and n.shape[1] > 2:
        return None
    if rival.each:
        halves = [(few, torch.arange(len(best)))] * 2
    options: Any = {"steps": 7, "each": rival.each}
    for (part, learns), (_, is_judged) in (halves, halves[::-1]):
        tries = []
        for start in rival.start:
            begin = torch.tensor(start, dtype=torch.float64).expand(len(learns), -1)
            motion = None if few.has_poses else best[learns]
            motion, end = descended(part, motion, rival.change, begin, **options)
            changed = rival.change(part, end)
            left = px_of(residual(changed, changed.motion if motion is None else motion))
            tries.append((median(left.nan_to_num(math.inf)), end))
        n[is_judged] = min(tries, key=lambda tried: tried[0])[1][: None if rival.each else 1]
    if rival.each:  # (of the frame, of the one before): each from the other pair that it is in
        follows = (few.path[1:, 1] == few.path[:-1, 2]).flatten(1).all(1)
        if not follows.any():
            return None
        own = n.clone()
        n[:-1, 0] = torch.where(follows, own[1:, 1], own[:-1, 0])
        n[1:, 1] = torch.where(follows, own[:-1, 0], own[1:, 1])
    factors, most = n[:, first != 0] / first[first != 0], _LARGEST_FACTORS.get(rival.of)
    if most is not None and not ((factors > 1 / most) & (factors < most)).all():
        return None
    return n


def _mapped(pairs: Pairs, best: Tensor) -> Tensor:
    """Returns the errors of poses that are corrected as the other pairs tell, px `[P]`.

    Each motion is corrected by a linear function of it. Whatever distorts poses in one and the same
    way, a convention that nobody listed too, is mended by it; noise of poses isn't.
    """
    recorded, wanted = motion_vector(pairs.motion), motion_vector(best)
    focal, inverse = pairs.K[:, 0, 0].median(), pairs.depth.reciprocal().nanmedian()
    unit = torch.cat([focal.expand(3), (focal * inverse).expand(3)])  # all in pixels
    x, y = recorded * unit, (wanted - recorded) * unit
    x = torch.cat([x, x.norm(dim=-1).median().expand(len(x), 1) / 2.4], 1)
    # The normal equations of all pairs but one, for each.
    A = x.mT @ x - x.unsqueeze(-1) * x.unsqueeze(-2)
    b = x.mT @ y - x.unsqueeze(-1) * y.unsqueeze(-2)
    size, errors = A.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] / len(x), []
    for damping in (0.03, 0.3, 3.0):
        told = torch.linalg.solve_ex(A + damping * size * torch.eye(7), b)[0]
        correction = (x.unsqueeze(-2) @ told).squeeze(-2) / unit
        errors.append(apart(pairs, small_motion(recorded + correction), best))
    return min(errors, key=median)


def _smoothed(pairs: Pairs, best: Tensor) -> Tensor:
    """Returns what the best motion leaves without its structure over picture and depth, px `[P]`.

    A polynomial of the pixel's place and inverse depth, fitted to every other block of the picture,
    is subtracted in the others. Where K, depth and flow fit each other, noise alone is left.
    """
    left, (height, width) = residual(pairs, best), pairs.now.shape[-2:]
    x, y = (pairs.place.nan_to_num() / torch.tensor([[width], [height]])).unbind(1)
    q = pairs.depth.reciprocal().nan_to_num(0.0, 0.0, 0.0).clamp(min=0.0)
    q = (q / q.median(-1, keepdim=True).values.clamp(min=1e-9)).clamp(max=3.0) - 1
    powers = [(a, b, c) for a in range(4) for b in range(4 - a) for c in range(3)]
    terms = torch.stack([(2 * x - 1) ** a * (2 * y - 1) ** b * q**c for a, b, c in powers], -1)
    is_even, out = ((5 * x).floor() + (4 * y).floor()) % 2 == 0, left
    for half in (is_even, ~is_even):
        known = half & left.isfinite().all(1)
        weight = known.double()
        for _ in range(4):
            weighted = terms * weight.unsqueeze(-1)
            A, b = weighted.mT @ terms, weighted.mT @ left.nan_to_num().mT
            A = A + torch.diag_embed(1e-3 * A.diagonal(dim1=-2, dim2=-1) + 1e-9)
            rest = left - (terms @ torch.linalg.solve_ex(A, b)[0]).mT
            squared = torch.where(known, rest.square().sum(1), math.inf)
            scale = scale_of(squared, pairs).square().unsqueeze(-1)
            weight = known / (1 + squared / scale).square()
        out = torch.where(half.unsqueeze(1), out, rest)
    return px_of(out)
