"""An explanation of pairs of frames: the data as recorded, or as a known mistake is undone.

The recorded motion is one of those that a picture shows, up to the noise of poses, which is learnt,
and up to the covariance with which the pixels determine it. The score of an explanation is a
log-likelihood, nats: that of the pixels by the motions that the picture shows, once the explanation
has changed the data, and that of the recorded motions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from flowrep.diagnosis.fit import EYE, Pairs, flow_of, length, median, motion_vector
from flowrep.diagnosis.pictures import Metric, Mixture, best_of
from flowrep.diagnosis.rivals import Rival

# Nats that an explanation has to be better by: 15 are the odds of a hundred thousand to one for one
# of fifty rivals; noise that pixels share doubles what chance gives.
SURE = 25.0
_MOST_NATS = 10.0  # that a pair counts for or against an explanation, of few pairs more
_BODY = 0.03  # of the pixels: a motion of fewer may be chance
_FEW_PAIRS = 3  # that show a body
_DECIDES = 3.0  # nats, between two models of noise: twenty to one
_RATES = (0.02, 0.3)  # shares of pairs whose poses are bad


class Poses(NamedTuple):
    """How recorded motions `[P]` fit a mixture's: `y` `[P, 6]` is the deviation, px.

    Its length is the root mean square of the flow that it causes over the motion's pixels. `cov`
    `[P, 6, 6]` is that of the picture's motion, `noise_px` the learnt noise of rotation and of
    translation, `noise` `[P, 6, 6]` both, `nats` `[P]` the log-likelihood, nan where a motion is
    unknown, `deviations` `[6]` the noise as rotation and
    translation, `is_bad` whether a pair's pose is off by more than noise, `mode` the motion of the
    picture that it is compared with, and `root` that motion's, see `Metric`.
    """

    y: Tensor
    cov: Tensor
    root: Tensor
    nats: Tensor
    noise_px: tuple[float, float]
    noise: Tensor
    is_bad: Tensor
    mode: Tensor
    deviations: Tensor

    @property
    def sigma_px(self) -> Tensor:
        """The standard deviation of the pictures' motion, `[P]`."""
        return self.cov.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()


def most_noise_px(pairs: Pairs, flow_px: float) -> float:
    """Returns the noise of poses beyond which they are no noisy ones."""
    return max(0.25 * flow_px, 0.005 * pairs.focal_px)  # a quarter of the flow, 0.005 rad


def poses(
    motion: Tensor, shown: Mixture, by: Metric, flow_px: float, least_px: float, most_px: float,
    correction: Tensor | float = 0.0,
) -> Poses:  # fmt: skip
    """Returns how motions `[P, 4, 4]` fit those of the pictures.

    The noise of poses is learnt, between the least and the most. The correction [P, 6] is that of
    the deviations, px.
    """
    y = _deviation(motion, shown, by) - correction
    root, cov = by.root, by.cov
    is_shown, is_known = shown.motions[..., 0, 0].isfinite(), motion.isfinite().flatten(1).all(-1)
    of_turn, of_shift = (half @ half.mT for half in root.split(3, -1))
    likely = shown.log_odds.argmax(0), torch.arange(len(motion))
    units = [median(x[likely].diagonal(dim1=-2, dim2=-1).sum(-1)) for x in (of_turn, of_shift)]
    of_turn, of_shift = of_turn / units[0], of_shift / units[1]
    sizes = torch.logspace(math.log10(least_px), math.log10(most_px), 6).double()
    turn, shift = (x.flatten() for x in torch.meshgrid(sizes, sizes, indexing="ij"))
    turn, shift = (x[:, None, None, None, None] for x in (turn, shift))
    of_picture = cov + least_px**2 / 6 * torch.eye(6)
    V = of_turn * turn.square() + of_shift * shift.square() + of_picture
    # Beside the odds, how many motions fit the pixels as well (Laplace's approximation).
    L = torch.linalg.cholesky_ex(of_picture)[0]
    odds = shown.log_odds + L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
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
    noise = (turn[i].square() * of_turn + shift[i].square() * of_shift)[at, pair]
    noise_px = float(turn[i]), float(shift[i])
    deviations = torch.tensor([px / math.sqrt(unit) for px, unit in zip(noise_px, units)]).double()
    nats = torch.where(is_known, nats, math.nan)
    return Poses(y[at, pair], cov[at, pair], root[at, pair], nats, noise_px, noise,
                 is_bad & is_known, at, deviations.repeat_interleave(3))  # fmt: skip


def _deviation(motion: Tensor, shown: Mixture, by: Metric) -> Tensor:
    """Returns what motions differ by from those of pictures, px, `[M, P, 6]`."""
    there = torch.where(shown.motions.isfinite(), shown.motions, EYE)
    known = torch.where(motion.isfinite(), motion, EYE)
    apart = motion_vector(known @ torch.linalg.inv_ex(there)[0])
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
    metric: Metric
    poses: Poses | None  # without poses, None
    handicap: float = 0.0  # nats

    @cached_property
    def of_pairs(self) -> Tensor:
        """The score of each pair, nats `[P]`; without a motion, as the others' on average."""
        if self.poses is None:
            return self.shown.nats
        of_poses = self.poses.nats
        mean = of_poses.nanmean().nan_to_num(-1e6)
        return self.shown.nats + torch.where(of_poses.isnan(), mean, of_poses)

    @property
    def nats(self) -> float:
        """The score, nats."""
        return float(self.of_pairs.sum()) - self.handicap

    def sure_nats(self, recorded: Explanation) -> float:
        """Returns by how much pairs agree that it is better than the data as recorded."""
        return agreed(self.of_pairs - recorded.of_pairs) - self.handicap

    @property
    def deviation_px(self) -> float:
        """How far recorded motions are from those of the pictures, without the latter's noise."""
        assert self.poses is not None
        used = ~self.poses.is_bad if self.is_beside_bodies else slice(None)
        square = (
            median(self.poses.y.norm(dim=-1)[used]) ** 2 - median(self.poses.sigma_px[used]) ** 2
        )
        return math.sqrt(max(square, 0.0))

    @cached_property
    def is_beside_bodies(self) -> bool:
        """Whether some pairs show the recorded motion beside another: that of a body.

        Where pairs show another motion alone, the body may fill the picture.
        """
        assert self.poses is not None
        pair, known = torch.arange(len(self.poses.y)), ~self.pairs.depth.isnan()
        others = self.shown.odds.amax(0) - self.shown.odds[self.poses.mode, pair]
        share = torch.where(known, others, math.nan).nanmean(-1)
        is_beside = (share > _BODY) & ~self.poses.is_bad
        return self.pairs.by_flow and int(is_beside.sum()) >= _FEW_PAIRS

    @cached_property
    def systematic_px(self) -> tuple[float, float]:
        """Returns the error that all recorded motions share, and twice its standard deviation."""
        found, pair = self.poses, torch.arange(len(self.shown.nats))
        assert found is not None
        used = found.nats.isfinite()
        used = used & ~found.is_bad if (used & ~found.is_bad).any() else used
        information = self.metric.information[found.mode, pair] * used[:, None, None]
        most_px = self.metric.most_px[found.mode, pair][used].median()
        # Noise is that of motions, or else that of poses, which the two pairs of a frame share.
        follows = self.pairs.follows
        of_motions, of_poses = (
            _common(found, information, most_px, joint) for joint in (0 * follows, follows)
        )
        c, cov, _ = of_poses if of_poses[2] > of_motions[2] + _DECIDES else of_motions
        root = found.root[used]
        square = (root @ cov @ root.mT).diagonal(dim1=-2, dim2=-1).sum(-1)
        return median((root @ c).norm(dim=-1)), 2 * median(square.clamp(min=0).sqrt())

    @property
    def motion(self) -> Tensor:
        """The recorded motion, or that of the picture if there is none, [P, 4, 4]."""
        return self.pairs.motion if self.poses is not None else best_of(self.shown)

    def effect_px(self, recorded: Explanation) -> float:
        """Returns how far ego or object flow differs from that of the data as recorded."""
        ego, other = (flow_of(each.pairs, each.motion) for each in (recorded, self))
        other = -other if self.rival.reverses else other
        apart = [other - ego]
        if self.pairs.by_flow:
            gain = self.pairs.gain.expand(len(ego), 2, 2) * (-1 if self.rival.reverses else 1)
            raw = torch.linalg.solve(gain, self.pairs.raw)
            apart.append((raw - other) - (recorded.pairs.raw - ego))
        known = recorded.pairs.raw.isfinite().all(1) & ~recorded.pairs.depth.isnan()
        known &= self.motion.isfinite().flatten(1).all(1, keepdim=True)  # at ends of a recording
        sizes = [length(x).nan_to_num(1e4, 1e4)[known] for x in apart]
        return max(float(x.median()) if len(x) else 0.0 for x in sizes)


def _common(
    found: Poses, information: Tensor, most_px: Tensor, follows: Tensor
) -> tuple[Tensor, Tensor, float]:
    """Returns the motion `[6]` that deviations have in common, its covariance, and the evidence.

    Args:
        information: `[P, 6, 6]`, that of pictures of the deviations.
        follows: `[P - 1]`, whether pairs share the noise of the pose between them.
    """
    count = len(found.y)
    # The noise of each pose is a latent motion, as is the common one, which comes last.
    last = torch.arange(count) + torch.cat([torch.zeros(1), (~follows.bool()).cumsum(0)]).long()
    at = torch.zeros(count, int(last[-1]) + 3).double()
    each = torch.arange(count)
    at[each, last], at[each, last + 1], at[:, -1] = -1.0, 1.0, 1.0
    H = torch.einsum("pl,pij->pilj", at, found.root).flatten(2)
    of_noise = found.deviations.square() / 2
    common = (found.root.mT @ found.root).mean(0) / most_px.square()
    prior = torch.block_diag(*[of_noise.reciprocal().diag()] * (at.shape[1] - 1), common)
    A = prior + (H.mT @ information @ H).sum(0)
    b = (H.mT @ information @ found.y.unsqueeze(-1)).sum(0).squeeze(-1)
    cov = torch.linalg.inv(A)
    n = cov @ b
    evidence = b @ n + prior.logdet() - A.logdet()
    return n[-6:], cov[-6:, -6:], float(evidence / 2)


def agreed(nats: Tensor) -> float:
    """Returns the nats by which pairs `[P]` agree on an explanation; none decides alone.

    It is the sum less twice its standard deviation: errors that pixels share make the nats of a
    pair too large, but not those of all pairs alike.
    """
    most = max(_MOST_NATS, 2 * SURE / len(nats))
    nats = nats[~nats.isnan()].clamp(-most, most)
    return float(nats.sum() - 2 * math.sqrt(len(nats)) * nats.std(correction=0))


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
    size = y.square().sum(-1, keepdim=True)
    weight = 1 / (1 + size / size.median().clamp(min=1e-12))
    each = (weight * x).unsqueeze(-1) * x.unsqueeze(-2)
    right = (weight * x).unsqueeze(-1) * y.unsqueeze(-2)
    A, b = each.sum(0) - each, right.sum(0) - right  # of all pairs but one, for each
    A = A + 0.3 * A.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] / len(x) * torch.eye(7)
    return (x.unsqueeze(-2) @ torch.linalg.solve_ex(A, b)[0]).squeeze(-2).nan_to_num()
