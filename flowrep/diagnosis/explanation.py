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

import torch
from torch import Tensor

from flowrep.diagnosis.fit import Pairs, flow_of, length, median
from flowrep.diagnosis.limits import BODY, FEW, PAIR, SURE
from flowrep.diagnosis.mistakes import Mistake
from flowrep.diagnosis.pictures import Metric, Mixture, best_of
from flowrep.diagnosis.poses import Poses


@dataclass(frozen=True, eq=False)
class Explanation:
    """The data as recorded, or after a mistake is undone."""

    mistake: Mistake
    n: Tensor  # [k], the mistake's numbers
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

    def sure_nats(self, other: Explanation) -> float:
        """Returns by how much pairs agree that it is better than another one."""
        return agreed(self.of_pairs - other.of_pairs) - self.handicap + other.handicap

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
        is_beside = (share > BODY) & ~self.poses.is_bad
        return self.pairs.by_flow and int(is_beside.sum()) >= FEW

    @property
    def own_share(self) -> float:
        """The share of the known pixels that follow the recorded motion, else the likeliest."""
        odds, pair = self.shown.odds, torch.arange(len(self.pairs.K))
        own = self.shown.log_odds.argmax(0) if self.poses is None else self.poses.mode
        return float(odds[own, pair][~self.pairs.depth.isnan()].mean())

    @cached_property
    def systematic_px(self) -> tuple[float, float]:
        """The error that all recorded motions share, and twice its standard deviation."""
        assert self.poses is not None
        return self.poses.shared_px(self.pairs.follows)

    @property
    def motion(self) -> Tensor:
        """The recorded motion, or that of the picture if there is none, [P, 4, 4]."""
        return self.pairs.motion if self.poses is not None else best_of(self.shown)

    def effect_px(self, recorded: Explanation) -> float:
        """Returns how far ego or object flow differs from that of the data as recorded."""
        ego, other = (flow_of(each.pairs, each.motion) for each in (recorded, self))
        other = -other if self.mistake.reverses else other
        apart = [other - ego]
        if self.pairs.by_flow:
            gain = self.pairs.gain.expand(len(ego), 2, 2) * (-1 if self.mistake.reverses else 1)
            raw = torch.linalg.solve(gain, self.pairs.raw)
            apart.append((raw - other) - (recorded.pairs.raw - ego))
        known = recorded.pairs.raw.isfinite().all(1) & ~recorded.pairs.depth.isnan()
        known &= ~self.pairs.depth.isnan()
        known &= self.motion.isfinite().flatten(1).all(1, keepdim=True)  # at ends of a recording
        sizes = [length(x).nan_to_num(1e4, 1e4)[known] for x in apart]
        return max(float(x.median()) if len(x) else 0.0 for x in sizes)


def agreed(nats: Tensor) -> float:
    """Returns the nats by which pairs `[P]` agree on an explanation; none decides alone.

    It is the sum less twice its standard deviation: errors that pixels share make the nats of a
    pair too large, but not those of all pairs alike.
    """
    most = max(PAIR, 2 * SURE / len(nats))
    nats = nats[~nats.isnan()].clamp(-most, most)
    return float(nats.sum() - 2 * math.sqrt(len(nats)) * nats.std(correction=0))
