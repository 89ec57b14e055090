"""What pairs of frames show: rigid motions, the static world's and those of bodies, and outliers.

Noise is learnt from the residuals of these motions, and so is how well pixels determine them.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from flowrep.diagnosis import fit
from flowrep.diagnosis.fit import EYE, Pairs, flow_of, length, median, residuals
from flowrep.diagnosis.limits import FEW_PIXELS, HARMLESS, MANY, ROUNDED

# Of residuals: Student's t, whose tails are those of measured flow and depth.
_FREEDOM = 4.0
_INTERPOLATED_PX = 0.03  # noise of depth between pixels at least: it is exact on planes only
_PARTS = 6, 4  # columns and rows of a picture, in which residuals may have a common error


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
    q, of_normal = near_share(pairs), 0.668 if pairs.by_flow else 0.598
    flow_px = median(length(pairs.raw)) if pairs.by_flow else 0.0
    px, share = HARMLESS if pairs.is_estimated else ROUNDED
    floor = max(_INTERPOLATED_PX, pairs.focal_px * pairs.grain)
    floor = px + share * flow_px if pairs.by_flow else floor
    ends = depth[depth.isfinite()].quantile(torch.tensor([0.25, 0.5, 0.75]).double())
    part, noise = torch.bucketize(depth.nan_to_num(), ends), torch.full_like(depth, floor)
    for i in range(4):
        is_in = (part == i) & size.isfinite()
        if is_in.sum() >= FEW_PIXELS:
            noise[part == i] = max(float(size[is_in].quantile(q)) / of_normal, floor)
    u = rest / noise.unsqueeze(1)
    u = torch.where(length(u).unsqueeze(1) < 3, u, 0.0)
    column, row = _parts(pairs)
    sums = torch.zeros(*u.shape[:2], math.prod(_PARTS)).double()
    sums.scatter_add_(-1, (column + _PARTS[0] * row).unsqueeze(1).expand_as(u), u)
    together = float(sums.square().sum() / u.square().sum().clamp(min=1e-12))
    return Noise(noise, min(max(together, 1.0), pairs.depth.shape[-1] / math.prod(_PARTS)))


def near_share(pairs: Pairs) -> float:
    """Returns the share of the pixels whose residuals show the noise: others may be outliers."""
    return MANY if pairs.by_flow else 0.45  # depth without movers, but with steps


def _parts(pairs: Pairs) -> tuple[Tensor, Tensor]:
    """Returns the column and the row `[P, N]` of the part of the picture that pixels are in."""
    across, down = _PARTS
    height, width = pairs.now.shape[-2:]
    part = pairs.pixel.nan_to_num() / torch.tensor([[width / across], [height / down]])
    column, row = part.long().unbind(1)
    return column.clamp(0, across - 1), row.clamp(0, down - 1)


def _density(rest: Tensor, noise: Noise) -> Tensor:
    """Returns the density of residuals `[..., P, C, N]`, 0 where unknown: as if none fits."""
    C, q = rest.shape[-2], (rest.square().sum(-2) / noise.px.square()) / _FREEDOM
    peak = 1 / (2 * math.pi * noise.px.square()) if C == 2 else 0.375 / noise.px
    return (peak * (1 + q) ** (-(_FREEDOM + C) / 2)).nan_to_num(0.0)


def _outlier_density(pairs: Pairs) -> Tensor:
    """Returns the density of residuals that no motion explains, 1 / px² or 1 / px, [P, 1]."""
    if not pairs.by_flow:
        return torch.full((len(pairs.K), 1), 0.5 / pairs.focal_px).double()
    most = length(pairs.raw).nanquantile(0.97, -1, keepdim=True).nan_to_num(1.0)
    return 1 / (4 * most + 1).square()


class Mixture(NamedTuple):
    """Motions `[M, P, 4, 4]` that pictures show, their shares `[M, P]`, pixels' odds `[M, P, N]`.

    `nats` `[P]` is the log-likelihood of a pair's pixels, relative to that of outliers alone.
    """

    motions: Tensor
    shares: Tensor
    odds: Tensor
    nats: Tensor
    log_odds: Tensor


def mixture(pairs: Pairs, motions: Tensor, noise: Noise) -> Mixture:
    """Returns those of some motions that the pixels of a pair need; by depth, all, as alternatives.

    Further motions are kept if they are worth their seven numbers, as in BIC.
    """
    rest, known = residuals(pairs, motions), ~pairs.depth.isnan()
    density = _density(rest, noise) / _outlier_density(pairs)
    number, M = known.sum(-1), len(motions)
    # Pixels that a correction leaves unknown count as the others do on average.
    total_number = pairs.raw.isfinite().all(1).sum(-1)
    weight = total_number / number.maximum(total_number / 2).clamp(min=1) / noise.together
    if not pairs.by_flow:  # one of these, since edges pull others about
        seen = rest.isfinite().all(-2)
        shares = torch.full((M, len(number)), 0.8).double()
        for _ in range(6):
            each = shares.unsqueeze(-1) * density
            odds = each / (each + 1 - shares.unsqueeze(-1)) * seen
            shares = ((odds.sum(-1) + 0.5) / (seen.sum(-1) + 2)).clamp(max=0.99)
        # Pixels that a motion takes out of the picture count as the others do on average.
        weight = number / seen.sum(-1).maximum(number / 2).clamp(min=1)
        nats = (shares.unsqueeze(-1) * (density - 1)).log1p() * seen
        nats = weight * nats.sum(-1) / noise.together
        return Mixture(motions, shares, odds, nats.amax(0), nats - nats.amax(0))

    def fitted(kept: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        shares = kept * 0.8 / kept.sum(0).clamp(min=1)
        for _ in range(6):
            each = shares.unsqueeze(-1) * density
            total = each.sum(0) + (1 - shares.sum(0)).unsqueeze(-1)
            odds = each / total * known
            shares = ((odds.sum(-1) + 0.5) / (number + 1 + M)).clamp(max=0.99) * kept
        return shares, odds, (total.log() * known).sum(-1) * weight

    cost = 7 * (number / noise.together).clamp(min=2).log() / 2
    kept = torch.zeros(M, len(number), dtype=torch.bool)
    best: Any = fitted(kept)
    left = known.double()
    # The likeliest motion first, then those that explain the pixels that these leave.
    for i in range(min(M, 4)):
        alone = ((0.5 * density + 0.5).log() * left).sum(-1).masked_fill(kept, -math.inf)
        tried_kept = kept.scatter(0, alone.argmax(0, keepdim=True), True)
        shares, odds, nats = fitted(tried_kept)
        tried = shares, odds, nats - (i + 1) * cost
        is_better = (tried[2] > best[2]) | (i == 0)
        kept = torch.where(is_better, tried_kept, kept)
        best = tuple(torch.where(is_better.unsqueeze(-1) if x.ndim == 3 else is_better, x, y)
                     for x, y in zip(tried, best))  # fmt: skip
        left = (1 - best[1].sum(0)) * known
    log_odds = best[0].clamp(min=1e-3).log()
    needed = torch.where(kept[..., None, None], motions, math.nan)
    return Mixture(needed, best[0], best[1], best[2], log_odds)


def either(one: Mixture, other: Mixture) -> Mixture:
    """Returns the motions of both mixtures, of which a picture shows the one or the other."""
    nats = one.nats.maximum(other.nats)
    fields = [torch.cat(both) for both in zip(one[:3], other[:3])]
    log_odds = torch.cat([each.log_odds + each.nats - nats for each in (one, other)])
    return Mixture(fields[0], fields[1], fields[2], nats, log_odds)


def best_of(shown: Mixture) -> Tensor:
    """Returns the likeliest motion, [P, 4, 4]."""
    return shown.motions[shown.log_odds.argmax(0), torch.arange(shown.shares.shape[1])]


class Metric(NamedTuple):
    """Of a mixture's motions: `root` `[M, P, 6, 6]` makes px of a small motion.

    `information` `[M, P, 6, 6]` is what pixels have of it, 1 / px², `cov` the covariance with the
    prior: nothing is off by more than `most_px` `[M, P]`.
    """

    root: Tensor
    cov: Tensor
    information: Tensor
    most_px: Tensor


def metric(pairs: Pairs, shown: Mixture, noise: Noise) -> Metric:
    """Returns how small motions after those of a mixture change flow, and are determined."""
    few, step = pairs.few, 1e-6
    number = few.depth.shape[-1]
    motions = torch.where(shown.motions.isfinite(), shown.motions, EYE)
    tries = fit.small_motion(step * torch.cat([torch.zeros(1, 6), torch.eye(6)]).double())
    moved = tries[:, None, None] @ motions

    def jacobian(maps: Tensor) -> Tensor:
        return ((maps[1:] - maps[:1]) / step).nan_to_num(0.0, 0.0, 0.0).clamp(-1e6, 1e6)

    flow, rest = flow_of(few, moved), residuals(few, moved)
    J, odds, px = jacobian(flow), shown.odds[..., :number], noise.px[:, :number]
    total = odds.sum(-1).clamp(min=1)
    A = torch.einsum("impcn,jmpcn,mpn->mpij", J, J, odds) / total[..., None, None]
    size = A.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
    root = torch.linalg.cholesky_ex(A + (1e-9 * size + 1e-14) * torch.eye(6))[0].mT
    # Fisher's information of Student's t, by the pixels that are fitted for all.
    C, q = rest.shape[-2], rest[0].square().sum(-2).nan_to_num(1e6) / px.square()
    weight = (_FREEDOM + C) ** 2 / (_FREEDOM + C + 2) / (_FREEDOM + q)
    weight = weight * odds / px.square() / noise.together * pairs.depth.shape[-1] / number
    J = pairs.gain @ J if pairs.by_flow else jacobian(rest)
    back = torch.linalg.inv_ex(root)[0]
    information = back.mT @ torch.einsum("impcn,jmpcn,mpn->mpij", J, J, weight) @ back
    length_px = length(flow[0]).nan_to_num(0.0)
    most_px = 2 * (length_px * odds).sum(-1) / total + 1
    cov = torch.linalg.inv_ex(information + torch.eye(6) / most_px.square()[..., None, None])[0]
    if pairs.is_estimated:  # its errors are smooth: a motion shares them
        bias_px = HARMLESS[0] + HARMLESS[1] * length_px.median(-1).values
        cov = cov + bias_px.square()[..., None, None] / 6 * torch.eye(6)
    return Metric(root, cov, information, most_px)
