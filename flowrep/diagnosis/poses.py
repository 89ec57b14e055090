"""How recorded camera motions fit those that pictures show, up to noise, which is learnt."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from flowrep.diagnosis.fit import EYE, Pairs, median, motion_vector
from flowrep.diagnosis.limits import ALIKE, MOST_NOISE
from flowrep.diagnosis.pictures import Metric, Mixture

_RATES = (0.02, 0.3)  # shares of pairs whose poses are bad


class Poses(NamedTuple):
    """How recorded motions `[P]` fit a mixture's: `y` `[P, 6]` is the deviation, px.

    Its length is the root mean square of the flow that it causes over the motion's pixels. `mode`
    is the motion of the picture that it is compared with, `by` its metric, `[P, ...]`, `noise`
    `[6]` the learnt noise of rotation and translation, `noise_px` what it does to flow, `nats`
    `[P]` the log-likelihood, nan where a motion is unknown, and `is_bad` whether a pair's pose is
    off by more than noise.
    """

    y: Tensor
    mode: Tensor
    by: Metric
    noise: Tensor
    noise_px: tuple[float, float]
    nats: Tensor
    is_bad: Tensor

    @property
    def sigma_px(self) -> Tensor:
        """The standard deviation of the pictures' motion, `[P]`."""
        return self.by.cov.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()

    def shared_px(self, follows: Tensor) -> tuple[float, float]:
        """Returns the length of the error that all motions share, and twice its deviation.

        Noise is that of motions, or else that of poses, of which two motions share the one between
        them, so that most of it cancels.

        Args:
            follows: `[P - 1]`, whether a pair ends where the next one begins.
        """
        known = self.nats.isfinite()
        used = known & ~self.is_bad if (known & ~self.is_bad).any() else known
        of_motions, of_poses = (
            self._shared(used, chain) for chain in (torch.zeros_like(follows), follows)
        )
        c, cov, _ = of_poses if of_poses[2] > of_motions[2] + ALIKE else of_motions
        root = self.by.root[used]
        square = (root @ cov @ root.mT).diagonal(dim1=-2, dim2=-1).sum(-1)
        return median((root @ c).norm(dim=-1)), 2 * median(square.clamp(min=0).sqrt())

    def _shared(self, used: Tensor, follows: Tensor) -> tuple[Tensor, Tensor, float]:
        """Returns the motion `[6]` that errors have in common, its covariance, and the evidence."""
        pair, root = torch.arange(len(self.y)), self.by.root
        # The noise of each pose is a latent motion, as is the common one, which comes last.
        last = pair + functional.pad((~follows).cumsum(0), (1, 0))
        at = torch.zeros(len(pair), int(last[-1]) + 3).double()
        at[pair, last], at[pair, last + 1], at[:, -1] = -1.0, 1.0, 1.0
        H = torch.einsum("pl,pij->pilj", at, root).flatten(2)
        of_noise = (2 / self.noise.square()).diag()  # a motion's noise is that of two poses
        of_common = (root.mT @ root).mean(0) / self.by.most_px[used].median().square()
        prior = torch.block_diag(*[of_noise] * (at.shape[1] - 1), of_common)
        weighted = H.mT @ self.by.information * used[:, None, None]
        A, b = prior + (weighted @ H).sum(0), (weighted @ self.y.unsqueeze(-1)).sum(0)
        cov = torch.linalg.inv_ex(A)[0]
        n = cov @ b
        evidence = (b.mT @ n).squeeze() + prior.logdet() - A.logdet()
        return n[-6:, 0], cov[-6:, -6:], float(evidence / 2)


def most_noise_px(pairs: Pairs, flow_px: float) -> float:
    """Returns the noise of poses beyond which they are no noisy ones."""
    return max(MOST_NOISE * flow_px, 0.005 * pairs.focal_px)  # 0.005 rad


def compared(
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
        if best is None or float(total[i]) > best[0] + ALIKE:
            best = float(total[i]), nats[i], i, math.log(rate) + wide > math.log(1 - rate) + each[i]
    _, nats, i, is_bad = best
    pair, at = torch.arange(len(motion)), mode[i]
    noise_px = float(turn[i]), float(shift[i])
    noise = torch.tensor([px / math.sqrt(unit) for px, unit in zip(noise_px, units)]).double()
    own, nats = Metric(*(each[at, pair] for each in by)), torch.where(is_known, nats, math.nan)
    noise = noise.repeat_interleave(3)
    return Poses(y[at, pair], at, own, noise, noise_px, nats, is_bad & is_known)


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


def by_a_rule(found: Poses, shown: Mixture) -> Tensor:
    """Returns the deviations of poses that a linear function of the motion predicts, `[P, 6]`, px.

    Each pair's is fitted to the other pairs. Errors that follow a rule, such as those of a
    convention that no table lists, are predicted; noise of poses is not.
    """
    y = found.y
    # The picture's motion, since the recorded one has the noise that it would then predict.
    motion = shown.motions[found.mode, torch.arange(len(y))]
    x = (found.by.root @ motion_vector(motion).unsqueeze(-1)).squeeze(-1)
    x = torch.cat([x, x.norm(dim=-1).median().expand(len(x), 1) / 2.4], 1)
    size = y.square().sum(-1, keepdim=True)
    weight = 1 / (1 + size / size.median().clamp(min=1e-12))
    each = (weight * x).unsqueeze(-1) * x.unsqueeze(-2)
    right = (weight * x).unsqueeze(-1) * y.unsqueeze(-2)
    A, b = each.sum(0) - each, right.sum(0) - right  # of all pairs but one, for each
    A = A + 0.3 * A.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] / len(x) * torch.eye(7)
    return (x.unsqueeze(-2) @ torch.linalg.solve_ex(A, b)[0]).squeeze(-2).nan_to_num()
