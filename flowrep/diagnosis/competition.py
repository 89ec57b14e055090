"""The explanations of some pairs of frames, of which the likeliest is the diagnosis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from flowrep.diagnosis import explanation, fit, pictures, poses
from flowrep.diagnosis.candidates import Candidate, candidate
from flowrep.diagnosis.explanation import Explanation
from flowrep.diagnosis.fit import EYE, Pairs, flow_of, length, median, residuals
from flowrep.diagnosis.limits import REST_PX, SURE
from flowrep.diagnosis.mistakes import FAR, NO_MISTAKE, OF_NOISE, STILL, Mistake
from flowrep.diagnosis.pictures import Metric, Mixture, Noise
from flowrep.geometry.egomotion import motion_of_points

_SCORED = 9  # corrections of the data that compete in full, those that fit best with exact poses


class Competition:
    """Explains pairs, with one noise for all explanations: the least that any of them leaves.

    Attributes:
        mistakes: those that the data let compete.
        recorded: the data as recorded.
        others: the data after each mistake is undone.
        of_noise: that raw flow is noise, if there are mistakes that change raw flow.
        far: that all is so far away that no motion but turns shows, if there are poses.
        still: that the camera stands still.
        noise: that of all explanations.
        flow_px: the median length of flow.
        ego_px: that of ego flow as recorded.
        rule_px: the errors of poses that a rule predicts, see `poses.by_a_rule`.
        rule_nats: what speaks for the rule.
    """

    def __init__(self, pairs: Pairs, mistakes: Sequence[Mistake]) -> None:
        if not pairs.by_flow and pairs.has_poses:
            pairs = _in_both_pictures(pairs)
        self._has_poses = pairs.has_poses  # at the ends of a recording, candidates may have none
        self.mistakes = [x for x in mistakes if pairs.has_poses or x.subject != "poses"]
        starts, shown, noise = _first_look(pairs, self.mistakes)
        likely = pictures.best_of(shown)
        self.ego_px = median(fit.middle(flow_of(pairs, pairs.motion))) if pairs.has_poses else 0.0
        self.flow_px = median(fit.middle(pairs.raw if pairs.by_flow else flow_of(pairs, likely)))
        own = torch.where(pairs.motion.isfinite(), pairs.motion, EYE) if pairs.has_poses else likely
        found = (candidate(pairs, mistake, own, noise.px) for mistake in self.mistakes)
        of_poses: list[Candidate] = []
        of_data: list[Candidate] = []
        for each in (x for x in found if x is not None):
            if each.mistake.subject == "poses":
                of_poses.append(each)
            elif each.misfit < math.inf:  # a mirrored half of a picture may have no depth at all
                of_data.append(each)
        # Without poses, the motion that a correction makes fit isn't known yet: all compete.
        scored = _SCORED if pairs.has_poses else len(of_data)
        of_data = sorted(of_data, key=lambda each: each.misfit)[:scored]
        recorded, still, of_noise, far = (
            Candidate(mistake, pairs.depth[:, :0], mistake.change(pairs, pairs.depth[:, :0]))
            for mistake in (NO_MISTAKE, STILL, OF_NOISE, FAR)
        )
        has_flow = any(each.mistake.subject == "flow" for each in of_data)
        nulls = [recorded] + [of_noise] * has_flow + [far] * pairs.has_poses
        motions = _motions([*nulls, *of_data], starts, shown, noise)
        noises = (_noise(each.pairs, own) for each, own in zip([*nulls, *of_data], motions))
        self.noise = min(noises, key=lambda each: float(each.px.log().mean()))
        least_px = 1e-3 if pairs.by_flow else 1e-2
        most_px = max(poses.most_noise_px(pairs, self.flow_px), 2 * least_px)
        self._limits = self.flow_px, least_px, most_px
        explained = [self._explained(*both) for both in zip([*nulls, *of_data], motions)]
        self.recorded, *self.others = explained
        self.of_noise = self.others.pop(0) if has_flow else None
        self.far = self.others.pop(0) if pairs.has_poses else None
        self.others += [self._of_poses(each) for each in of_poses]
        self.still = self._of_poses(still) if pairs.has_poses else None
        self.rule_px = self.rule_nats = 0.0
        if self.recorded.poses is not None and len(pairs.K) >= 8:
            shown, metric = self.recorded.shown, self.recorded.metric
            rule = poses.by_a_rule(self.recorded.poses, shown)
            after = poses.compared(pairs.motion, shown, metric, *self._limits, rule)
            self.rule_px = median(rule.norm(dim=-1))
            self.rule_nats = explanation.agreed(after.nats - self.recorded.poses.nats)

    def is_proven(self, other: Explanation) -> bool:
        """Whether data also show K or depth, if it changes these: as far away, none matters."""
        null = self.far if other.mistake.subject in ("camera", "depth") else None
        return self.is_seen(other) and (null is None or other.nats - null.nats > SURE)

    def is_seen(self, other: Explanation) -> bool:
        """Whether data show what it needs: raw flow beyond noise, or else a camera that moves.

        Beside a camera at rest, flow shows bodies and noise, whatever its conventions.
        """
        of_flow = other.mistake.subject == "flow"
        if of_flow and self._has_poses and self.ego_px <= REST_PX:
            return False
        null = self.of_noise if of_flow else self.still
        return null is None or other.nats - null.nats > SURE

    def _explained(self, by: Candidate, motions: Tensor) -> Explanation:
        """Returns a candidate that changes what pictures show, given motions `[M, P, 4, 4]`."""
        shown = pictures.mixture(by.pairs, motions, self.noise)
        if by.mistake is NO_MISTAKE and by.pairs.by_flow and by.pairs.has_poses:
            shown = pictures.either(shown, _beside_bodies(by.pairs, self.noise))
        return self._scored(by, shown, pictures.metric(by.pairs, shown, self.noise))

    def _of_poses(self, by: Candidate) -> Explanation:
        """Returns a candidate that changes poses alone: pictures show what they do as recorded."""
        found = self._scored(by, self.recorded.shown, self.recorded.metric)
        if by.mistake.of_time:
            # Poses between two recorded ones have less noise: only what the opposite time doesn't
            # gain speaks for a delay.
            pairs = by.mistake.change(self.recorded.pairs, -found.n.expand(len(by.n), -1))
            back = self._scored(by._replace(pairs=pairs, surprise=0.0), found.shown, found.metric)
            gain = max(back.nats - self.recorded.nats, 0.0)
            found = replace(found, handicap=found.handicap + gain)
        return found

    def _scored(self, by: Candidate, shown: Mixture, metric: Metric) -> Explanation:
        of_poses, n = None, by.n.nanmedian(0).values
        if self._has_poses:
            of_poses = poses.compared(by.pairs.motion, shown, metric, *self._limits)
        return Explanation(by.mistake, n, by.pairs, shown, metric, of_poses, by.surprise)


def _in_both_pictures(pairs: Pairs) -> Pairs:
    """Returns pairs without pixels that the recorded motion takes out of the picture.

    They are no evidence against it, unless they are most.
    """
    seen, known = residuals(pairs, pairs.motion)[:, 0].isfinite(), ~pairs.depth.isnan()
    is_most = seen.sum(-1, keepdim=True) > 0.5 * known.sum(-1, keepdim=True)
    return pairs._replace(depth=pairs.depth.masked_fill(~seen & is_most, math.nan))


def _first_look(pairs: Pairs, mistakes: Sequence[Mistake]) -> tuple[Tensor, Mixture, Noise]:
    """Returns motions `[M, P, 4, 4]` as a start for fits, which the pictures show, and noise."""
    none = pairs.depth[:, :0]
    closed = [
        x.change(pairs, none).motion for x in mistakes if x.subject == "poses" and not x.start[0]
    ]
    starts = _starts(pairs, closed)
    starts = fit.refined(pairs, starts, _noise(pairs, starts).px)
    shown = pictures.mixture(pairs, starts, _noise(pairs, starts))
    # The residuals of each pixel's likeliest motion, unless it is none's.
    rest, (odds, motion) = residuals(pairs, starts), shown.odds.max(0)
    own = rest.gather(0, motion[None, :, None].expand(1, -1, rest.shape[2], -1))[0]
    left = torch.where(odds.unsqueeze(1) > 0.3, own, math.nan)
    return starts, shown, pictures.learnt_noise(pairs, left)


def _motions(
    candidates: Sequence[Candidate], starts: Tensor, shown: Mixture, noise: Noise
) -> list[Tensor]:
    """Returns the motions `[M, P, 4, 4]` that pictures show by each candidate.

    Motions that any of them finds are tried on the data of all, also on those as recorded.
    """
    own = [_shown_by(each.pairs, shown, noise) for each in candidates]
    pool = torch.cat([starts, *own])
    return [
        torch.cat([of, fit.refined(by.pairs, _nearest(by.pairs, pool), noise.px, 4)])
        for by, of in zip(candidates, own)
    ]


def _starts(pairs: Pairs, closed: Sequence[Tensor]) -> Tensor:
    """Returns motions `[M, P, 4, 4]` that pictures may show, as a start for fits."""
    still = EYE.expand(len(pairs.K), 4, 4)
    known = [pairs.motion, *closed, still] if pairs.has_poses else [still]
    known = [torch.where(each.isfinite(), each, EYE) for each in known]
    size = length(residuals(pairs.few, torch.stack(known)))
    rank = size.nanquantile(0.4, -1).nan_to_num(math.inf).argmin(0)
    starts = [torch.stack(known)[rank, torch.arange(len(still))], known[0], still]
    left = torch.ones_like(pairs.depth, dtype=torch.bool)
    for _ in range(2 * pairs.by_flow):
        starts.append(motion_of_points(*_points(pairs), left))
        size = length(residuals(pairs, starts[-1]))
        left = left & ~(size < 3 * size.nanquantile(0.2, -1, keepdim=True))
    return torch.stack(starts)


def _shown_by(pairs: Pairs, shown: Mixture, noise: Noise) -> Tensor:
    """Returns motions that changed pictures show: those next to known ones, and a body's."""
    motion = pairs.motion
    if not pairs.has_poses:
        motion = motion_of_points(*_points(pairs), torch.ones_like(pairs.depth) > 0)
    found = fit.refined(pairs, torch.stack([motion, pictures.best_of(shown)]), noise.px, 4)
    number = shown.motions[..., 0, 0].isfinite().sum(0)
    if not pairs.by_flow or (number > 1).double().mean() <= 0.5:
        return found
    size = length(residuals(pairs, found)).nan_to_num(math.inf)
    near = size.nanquantile(0.2, -1, keepdim=True).argmin(0, keepdim=True)
    left = size.gather(0, near.expand(1, *size.shape[1:]))[0] > 5 * noise.px
    return torch.cat([found, _of_body(pairs, left, noise)])


def _beside_bodies(pairs: Pairs, noise: Noise) -> Mixture:
    """Returns the recorded motions beside others: bodies pull fits of the world to them."""
    motion = torch.where(pairs.motion.isfinite(), pairs.motion, EYE)
    left = length(residuals(pairs, motion)) > 2 * noise.px
    motions = torch.cat([motion.unsqueeze(0), _of_body(pairs, left, noise)])
    return pictures.mixture(pairs, motions, noise)


def _of_body(pairs: Pairs, left: Tensor, noise: Noise) -> Tensor:
    """Returns a motion `[1, P, 4, 4]` of the pixels that are left."""
    return fit.refined(pairs, motion_of_points(*_points(pairs), left).unsqueeze(0), noise.px, 4)


def _nearest(pairs: Pairs, pool: Tensor) -> Tensor:
    """Returns the two motions of a pool that leave least of many pixels, for each pair."""
    size = length(residuals(pairs.few, pool)).nanquantile(0.3, -1).nan_to_num(math.inf)
    return pool[size.argsort(0)[:2], torch.arange(pool.shape[1])]


def _noise(pairs: Pairs, motions: Tensor) -> Noise:
    """Returns the noise of the motion that leaves least of many pixels."""
    rest = residuals(pairs, motions)
    near = length(rest).nanquantile(pictures.near_share(pairs), -1).nan_to_num(math.inf).argmin(0)
    return pictures.learnt_noise(pairs, rest[near, torch.arange(len(near))])


def _points(pairs: Pairs) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns rays [P, 3, N], inverse depth, the flow that K's change doesn't cause, and K."""
    rays = torch.linalg.inv_ex(pairs.K)[0] @ fit.homogeneous(pairs.pixel)
    moved = (pairs.prev_K @ rays)[:, :2] - (pairs.pixel - torch.linalg.solve(pairs.gain, pairs.raw))
    return rays, pairs.depth.reciprocal(), moved, pairs.prev_K
