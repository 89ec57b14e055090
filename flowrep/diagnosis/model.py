"""One model of pairs of frames, by which all explanations of the data compete.

Each picture shows some rigid motions, the static world's and those of bodies, and outliers. The
recorded motion is that of one of them, up to the noise of poses, which is learnt, and up to the
covariance with which the pixels determine it. The score of an explanation is a log-likelihood,
nats: that of the pixels by the motions that the picture shows, once the explanation has changed
the data, and that of the recorded motions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from flowrep.diagnosis import fit
from flowrep.diagnosis.fit import EYE, Pairs, flow_of, length, median, motion_vector, residuals
from flowrep.diagnosis.rivals import Rival

# Of residuals: Student's t, whose tails are those of measured flow and depth.
_FREEDOM = 4.0
# Residuals have at least this noise: data are rounded, and depth is interpolated between pixels,
# which is exact on planes only; estimated flow is wrong by so much, smoothly, on any surface.
_ROUNDED = 1e-3, 5e-4  # px, and share of flow's length
_INTERPOLATED_PX = 0.03
_ESTIMATED = 0.05, 0.05  # px, and share of flow's length
PARTS = 6, 4  # columns and rows of a picture, in which residuals may have a common error
_RATES = (0.02, 0.3)  # shares of pairs whose poses are bad


class Noise(NamedTuple):
    """The noise of residuals, `px` `[P, N]`, and the number of pixels that share an error."""

    px: Tensor
    together: float

    @property
    def typical_px(self) -> float:
        """The median."""
        return median(self.px)


def learnt_noise(pairs: Pairs, rest: Tensor) -> Noise:
    """Returns the noise that residuals `[P, C, N]` of the best motions have, by depth."""
    size, depth = length(rest), pairs.depth.abs()
    size = torch.where(size.isfinite(), size, math.nan)
    # The fifth that is nearest to 0: others may be outliers. Of normal errors, it is below this.
    fifth = 0.668 if rest.shape[-2] == 2 else 0.2533
    flow_px = median(length(pairs.raw)) if pairs.by_flow else 0.0
    px, share = _ESTIMATED if pairs.is_estimated else _ROUNDED
    floor = px + share * flow_px if pairs.by_flow else _INTERPOLATED_PX
    ends = depth[depth.isfinite()].quantile(torch.tensor([0.25, 0.5, 0.75]).double())
    part, noise = torch.bucketize(depth.nan_to_num(), ends), torch.full_like(depth, floor)
    for i in range(4):
        is_in = (part == i) & size.isfinite()
        if is_in.sum() >= 24:
            noise[part == i] = max(float(size[is_in].quantile(0.2)) / fifth, floor)
    u = rest / noise.unsqueeze(1)
    u = torch.where(length(u).unsqueeze(1) < 3, u, 0.0)
    column, row = parts(pairs, *PARTS)
    sums = torch.zeros(*u.shape[:2], math.prod(PARTS)).double()
    sums.scatter_add_(-1, (column + PARTS[0] * row).unsqueeze(1).expand_as(u), u)
    together = float(sums.square().sum() / u.square().sum().clamp(min=1e-12))
    return Noise(noise, min(max(together, 1.0), pairs.depth.shape[-1] / math.prod(PARTS)))


def parts(pairs: Pairs, across: int, down: int) -> tuple[Tensor, Tensor]:
    """Returns the column and the row `[P, N]` of the part of the picture that pixels are in."""
    height, width = pairs.now.shape[-2:]
    part = pairs.pixel.nan_to_num() / torch.tensor([[width / across], [height / down]])
    column, row = part.long().unbind(1)
    return column.clamp(0, across - 1), row.clamp(0, down - 1)


def _density(rest: Tensor, noise: Noise) -> Tensor:
    """Returns the density of residuals `[..., P, C, N]`, 0 where unknown: as if none fits."""
    C, q = rest.shape[-2], (rest.square().sum(-2) / noise.px.square()) / _FREEDOM
    peak = 1 / (2 * math.pi * noise.px.square()) if C == 2 else 0.375 / noise.px
    return (peak * (1 + q) ** (-(_FREEDOM + C) / 2)).nan_to_num(0.0)


class Mixture(NamedTuple):
    """Motions `[M, P, 4, 4]` that pictures show, their shares `[M, P]`, pixels' odds `[M, P, N]`.

    `nats` `[P]` is the log-likelihood of a pair's pixels, relative to that of outliers alone.
    """

    motions: Tensor
    shares: Tensor
    odds: Tensor
    nats: Tensor


def mixture(
    pairs: Pairs, motions: Tensor, noise: Noise, outlier_density: Tensor, free: int = 6
) -> Mixture:
    """Returns those of some motions that pixels of a pair need, the first of alike ones.

    Args:
        free: the numbers of each motion that were fitted, but for the last motion: it has none.
    """
    rest, known = residuals(pairs, motions), ~pairs.depth.isnan()
    density = _density(rest, noise) / outlier_density
    number, M = known.sum(-1), len(motions)
    # By depth, pixels that a motion takes out of the picture count as the others do on average.
    inside = rest.isfinite().all(-2).sum(-1)
    weight = (
        torch.ones_like(inside.double()) if pairs.by_flow else number / inside.maximum(number / 2)
    )
    weight = weight.nan_to_num(1.0)
    half_log = (number / noise.together).clamp(min=2).log() / 2
    cost = (
        torch.tensor([1.0 + free] * (M - 1) + [1.0]).double().unsqueeze(1) * half_log
    )  # as in BIC
    kept = torch.zeros(M, len(number), dtype=torch.bool)

    def fitted(kept: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        shares = kept * 0.8 / kept.sum(0).clamp(min=1)
        for _ in range(6):
            each = shares.unsqueeze(-1) * density
            total = each.sum(0) + (1 - shares.sum(0)).unsqueeze(-1)
            odds = each / total * known
            shares = ((odds.sum(-1) + 0.5) / (number + 1 + M)).clamp(max=0.99) * kept
        by = (weight * kept).sum(0) / kept.sum(0).clamp(min=1)
        return shares, odds, by * (total.log() * known).sum(-1) / noise.together

    alone = (
        weight * ((0.5 * density + 0.5).log() * (known & (density > 0))).sum(-1) / noise.together
        - cost
    )
    best: Any = fitted(kept)
    # Beside flow, the likeliest motion first, then those that explain further pixels; by depth
    # alone, which edges pull about, one.
    for i in range(min(M, 4) if pairs.by_flow else 1):
        m = alone.masked_fill(kept, -math.inf).argmax(0, keepdim=True)
        tried = fitted(kept.scatter(0, m, True))
        is_better = tried[2] - best[2] > (cost.gather(0, m)[0] if i else -math.inf)
        kept = torch.where(is_better, kept.scatter(0, m, True), kept)
        best = tuple(torch.where(is_better.unsqueeze(-1) if x.ndim == 3 else is_better, x, y)
                     for x, y in zip(tried, best))  # fmt: skip
        # The next is judged by the pixels that those so far leave.
        rest = (1 - best[1].sum(0)) * known
        alone = ((0.5 * density + 0.5).log() * rest).sum(-1) / noise.together - cost
    return Mixture(torch.where(kept[..., None, None], motions, math.nan), *best)


class Poses(NamedTuple):
    """How recorded motions `[P]` fit a mixture's: `y` `[P, 6]` is the deviation, px.

    Its length is the root mean square of the flow that it causes over the motion's pixels. `cov`
    `[P, 6, 6]` is that of the picture's motion, `noise_px` the learnt noise of rotation and of
    translation, `nats` `[P]` the log-likelihood, nan where a motion is unknown, `is_bad` whether a
    pair's pose is no noisy one.
    """

    y: Tensor
    cov: Tensor
    root: Tensor
    nats: Tensor
    noise_px: tuple[float, float]
    is_bad: Tensor
    mode: Tensor


class Metric(NamedTuple):
    """Of a mixture's motions: `root` `[M, P, 6, 6]` makes px of a small motion, `cov` in px²."""

    root: Tensor
    cov: Tensor


def metric(pairs: Pairs, shown: Mixture, noise: Noise) -> Metric:
    """Returns how small motions after those of a mixture change flow, and are determined."""
    motions = torch.where(shown.motions.isfinite(), shown.motions, EYE)
    step, every, pairs = 1e-6, pairs.depth.shape[-1], pairs.few
    number = pairs.depth.shape[-1]
    ratio = every / number  # pixels for each of these
    tries = fit.small_motion(step * torch.cat([torch.zeros(1, 6), torch.eye(6)]).double())
    moved = tries[:, None, None] @ motions
    flow = flow_of(pairs, moved)
    J = ((flow[1:] - flow[:1]) / step).nan_to_num(0.0, 0.0, 0.0).clamp(-1e6, 1e6)
    odds, px = shown.odds[..., :number], noise.px[:, :number]
    A = torch.einsum("impcn,jmpcn,mpn->mpij", J, J, odds) / odds.sum(-1)[..., None, None].clamp(
        min=1
    )
    rest = residuals(pairs, motions)
    if not pairs.by_flow:
        r = residuals(pairs, moved)
        J = ((r[1:] - r[:1]) / step).nan_to_num(0.0, 0.0, 0.0).clamp(-1e6, 1e6)
    C = rest.shape[-2]
    q = rest.square().sum(-2).nan_to_num(1e6) / px.square()
    weight = ratio * odds / px.square() / noise.together * (_FREEDOM + C) / (_FREEDOM + q)
    weight = weight * (_FREEDOM + C) / (_FREEDOM + C + 2)  # Fisher's information of Student's t
    J = J if not pairs.by_flow else pairs.gain @ J
    H = torch.einsum("impcn,jmpcn,mpn->mpij", J, J, weight)
    size = A.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
    root = torch.linalg.cholesky_ex(A + (1e-9 * size + 1e-14) * torch.eye(6))[0].mT
    # The prior: nothing is off by more than the flow's length, and a pixel.
    most = (length(flow[0]).nan_to_num(0.0) * odds).sum(-1) / odds.sum(-1).clamp(min=1) * 2 + 1
    prior = root.mT @ root / most.square()[..., None, None]
    cov = root @ torch.linalg.inv_ex(H + prior + 1e-14 * torch.eye(6))[0] @ root.mT
    if pairs.is_estimated:  # its errors are smooth: a motion shares them
        px = _ESTIMATED[0] + _ESTIMATED[1] * length(flow[0]).nan_to_num(0.0).median(-1).values
        cov = cov + px.square()[..., None, None] / 6 * torch.eye(6)
    return Metric(root, cov)


def poses(
    motion: Tensor, shown: Mixture, by: Metric, flow_px: float, least_px: float, most_px: float,
    correction: Tensor | float = 0.0,
) -> Poses:  # fmt: skip
    """Returns how motions `[P, 4, 4]` fit those of the pictures.

    The noise of poses is learnt, between the least and the most. The correction [P, 6] is that of
    the deviations, px.
    """
    y = deviation(motion, shown, by) - correction
    root, cov = by
    is_shown, is_known = shown.motions[..., 0, 0].isfinite(), motion.isfinite().flatten(1).all(-1)
    of_turn, of_shift = (half @ half.mT for half in root.split(3, -1))
    of_turn, of_shift = (
        half / median(half.diagonal(dim1=-2, dim2=-1).sum(-1)[is_shown])
        for half in (of_turn, of_shift)
    )
    sizes = torch.logspace(math.log10(least_px), math.log10(most_px), 6).double()
    turn, shift = (x.flatten() for x in torch.meshgrid(sizes, sizes, indexing="ij"))
    V = (
        of_turn * turn.square()[:, None, None, None, None]
        + of_shift * shift.square()[:, None, None, None, None]
    )
    V = V + cov + least_px**2 / 6 * torch.eye(6)
    odds = shown.shares.clamp(min=1e-3).log()
    each, mode = torch.where(is_shown, _normal(y, V) + odds, -math.inf).max(1)
    # A bad pose may be anything: beyond some lengths of flow, all are as unlikely.
    size = 2 * flow_px + 4 * least_px + most_px
    wide = cov + torch.eye(6) * size**2 / 6
    near = y * (3 * size / y.norm(dim=-1, keepdim=True)).clamp(max=1.0)
    wide = torch.where(is_shown, _normal(near, wide) + odds, -math.inf).amax(0)
    best: Any = None
    for rate in _RATES:
        nats = torch.logaddexp(math.log(1 - rate) + each, math.log(rate) + wide)
        total = torch.where(is_known, nats, 0.0).sum(-1)
        i = int(total.argmax())
        if best is None or float(total[i]) > best[0] + 3:
            best = float(total[i]), nats[i], i, math.log(rate) + wide > math.log(1 - rate) + each[i]
    _, nats, i, is_bad = best
    pair, at = torch.arange(len(motion)), mode[i]
    return Poses(y[at, pair], cov[at, pair], root[at, pair], torch.where(is_known, nats, math.nan),
                 (float(turn[i]), float(shift[i])), is_bad & is_known, at)  # fmt: skip


def deviation(motion: Tensor, shown: Mixture, by: Metric) -> Tensor:
    """Returns what motions differ by from those of pictures, px, `[M, P, 6]`."""
    there = torch.where(shown.motions.isfinite(), shown.motions, EYE)
    apart = motion_vector(
        torch.where(motion.isfinite(), motion, EYE) @ torch.linalg.inv_ex(there)[0]
    )
    return (by.root @ apart.unsqueeze(-1)).squeeze(-1).clamp(-1e4, 1e4)


def _normal(y: Tensor, V: Tensor) -> Tensor:
    """Returns the log-density of y `[..., 6]` by a covariance, without its constant."""
    L = torch.linalg.cholesky_ex(V)[0]
    z = torch.linalg.solve_triangular(L, y.unsqueeze(-1).expand(*V.shape[:-1], 1), upper=False)
    return -0.5 * z.square().sum((-1, -2)) - L.diagonal(dim1=-2, dim2=-1).log().sum(-1)


@dataclass(frozen=True, eq=False)
class Explanation:
    """The data as recorded, or as a rival changes them."""

    rival: Rival
    n: Tensor  # [k], the rival's numbers
    pairs: Pairs
    shown: Mixture
    poses: Poses | None  # without poses, None
    handicap: float = 0.0  # nats

    @cached_property
    def nats(self) -> float:
        """The score, nats; pairs without a motion count as the others do on average."""
        count, of_poses = len(self.shown.nats), 0.0
        if self.poses is not None:
            of_poses = count * float(self.poses.nats.nanmean().nan_to_num(-1e6))
        numbers = count if self.rival.per_pair else len(self.n)
        return float(self.shown.nats.sum()) + of_poses - _NUMBER * numbers - self.handicap

    @property
    def motion(self) -> Tensor:
        """The recorded motion, or that of the picture if there is none, [P, 4, 4]."""
        return self.pairs.motion if self.poses is not None else best_of(self.shown)

    def effect_px(self, recorded: Explanation) -> float:
        """Returns how far ego or object flow differs from that of the data as recorded."""
        ego, other = (flow_of(each.pairs, each.motion) for each in (recorded, self))
        apart = [other - ego]
        if self.pairs.by_flow:
            gain = self.pairs.gain.expand(len(ego), 2, 2)
            raw = torch.linalg.solve(gain, self.pairs.raw)
            apart.append((raw - other) - (recorded.pairs.raw - ego))
        known = recorded.pairs.raw.isfinite().all(1) & ~recorded.pairs.depth.isnan()
        known &= self.motion.isfinite().flatten(1).all(1, keepdim=True)  # at ends of a recording
        sizes = [length(x).nan_to_num(1e4, 1e4)[known] for x in apart]
        return max(float(x.median()) if len(x) else 0.0 for x in sizes)


def by_a_rule(recorded: Explanation) -> Tensor:
    """Returns the deviations of poses that a linear function of the motion predicts, `[P, 6]`, px.

    Each pair's is fitted to the other pairs. Errors that follow a rule, such as those of a
    convention that no table lists, are predicted; noise of poses is not.
    """
    assert recorded.poses is not None
    y, root = recorded.poses.y, recorded.poses.root
    # The picture's motion, since the recorded one has the noise that it would then predict.
    shown = recorded.shown.motions[recorded.poses.mode, torch.arange(len(y))]
    x = (root @ motion_vector(shown).unsqueeze(-1)).squeeze(-1)
    x = torch.cat([x, x.norm(dim=-1).median().expand(len(x), 1) / 2.4], 1)
    weight = 1 / (1 + y.square().sum(-1) / y.square().sum(-1).median().clamp(min=1e-12)).unsqueeze(
        -1
    )
    each = (weight * x).unsqueeze(-1) * x.unsqueeze(-2)
    right = (weight * x).unsqueeze(-1) * y.unsqueeze(-2)
    A, b = each.sum(0) - each, right.sum(0) - right  # of all pairs but one, for each
    A = A + 0.3 * A.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] / len(x) * torch.eye(7)
    return (x.unsqueeze(-2) @ torch.linalg.solve_ex(A, b)[0]).squeeze(-2).nan_to_num()


def without_trend(pairs: Pairs, rest: Tensor, noise: Noise) -> Tensor:
    """Returns residuals `[P, C, N]` without their trend.

    A polynomial in the pixel's position and inverse depth is fitted to every other part of the
    picture and subtracted in the others. If K, depth and flow fit, only noise remains.
    """
    height, width = pairs.now.shape[-2:]
    x, y = (2 * pairs.pixel.nan_to_num() / torch.tensor([[width], [height]]) - 1).unbind(1)
    q = pairs.depth.reciprocal().nan_to_num(0.0, 0.0, 0.0).clamp(min=0.0)
    q = (q / q.median(-1, keepdim=True).values.clamp(min=1e-9)).clamp(max=3.0) - 1
    powers = [(a, b, c) for a in range(3) for b in range(3 - a) for c in range(3)]
    terms = torch.stack([x**a * y**b * q**c for a, b, c in powers], -1)
    column, row = parts(pairs, *PARTS)
    is_even, out = (column + row) % 2 == 0, rest
    for half in (is_even, ~is_even):
        known = half & rest.isfinite().all(1)
        weight = torch.ones_like(pairs.depth)
        for _ in range(3):
            weighted = terms * (known * weight).unsqueeze(-1)
            A, b = weighted.mT @ terms, weighted.mT @ rest.nan_to_num().mT
            A = A + torch.diag_embed(1e-2 * A.diagonal(dim1=-2, dim2=-1) + 1e-9)
            left = rest - (terms @ torch.linalg.solve_ex(A, b)[0]).mT
            weight = 1 / (1 + (length(left) / noise.px / 3).square().nan_to_num(1e9)).square()
        out = torch.where(half.unsqueeze(1), out, left)
    return out


_NUMBER = 2.0  # nats that each fitted number costs, beside that it is fitted to other pairs


def best_of(shown: Mixture) -> Tensor:
    """Returns the motion of the most pixels, [P, 4, 4]."""
    return shown.motions[shown.shares.argmax(0), torch.arange(shown.shares.shape[1])]


def outlier_density(pairs: Pairs) -> Tensor:
    """Returns the density of residuals that no motion explains, 1 / px² or 1 / px, [P, 1]."""
    if not pairs.by_flow:
        return torch.full((len(pairs.K), 1), 0.5 / pairs.focal_px).double()
    most = length(pairs.raw).nanquantile(0.97, -1, keepdim=True).nan_to_num(1.0)
    return 1 / (4 * most + 1).square()
