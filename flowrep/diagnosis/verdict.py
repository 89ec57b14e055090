"""The verdict on pairs of frames: which explanation of them is the likeliest, and what it hides."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from flowrep.diagnosis import fit, model
from flowrep.diagnosis.fit import EYE, Pairs, flow_of, length, median, residuals
from flowrep.diagnosis.model import Explanation, Metric, Noise
from flowrep.diagnosis.rivals import Rival, fitted_numbers
from flowrep.geometry.egomotion import motion_of_points

# An error that is smaller than each of these does nobody harm.
_HARMLESS_PX = 0.05
_HARMLESS = 0.05  # of the flow's length
_UNSURE = 0.15  # of the flow's length: with a larger error, even "right" would be of no use
_SURE = 25.0  # nats: the odds of a hundred thousand to one that one in fifty rivals has to have
# The noise of poses is below each of these; errors beyond both are no noise.
_NOISY = 0.5  # of the flow's length
_NOISY_RAD = 0.005
_MOSTLY = 0.7  # of a vague explanation's score: a mistake with a name explains as much
_HARDLY_PX = 0.25  # flow of a picture in which hardly anything moves
_MOST = 0.8  # of a picture: a motion that so many pixels follow is the world's
_SCORED = 9  # corrections of the data that compete in full, those that fit best with exact poses
_MANY_BAD_PAIRS = 0.2  # of all pairs: then a part of the recording is wrong
_MANY_OUTLIERS = 0.05  # of all pixels: a note then gives their share


@dataclass(frozen=True)
class Diagnosis:
    """A verdict on the conventions of some data; printed, it is a sentence and a table.

    Attributes:
        verdict: "wrong" if listed mistakes explain the data, "something is wrong" if none does.
        words: the reason, in a sentence.
        pairs: the number of pairs of frames that were examined.
        raw_px: median length of flow.
        left_px: median residual of the recorded data, |raw - ego| where flow is the reference.
        best_px: median residual with the best motion.
        error_px: the error of the recorded motion, without the noise. If the verdict is "right",
            the conventions are right to this many pixels.
        rivals_px: median residual after each correction, by correction.
        suspects: what corrects the data, the likeliest first; none if they are right.
        unseen: corrections that these data can neither confirm nor rule out.
        notes: further sentences: frames that stand out, and what could not be tested.
    """

    verdict: Literal["right", "wrong", "something is wrong", "can't tell"]
    words: str
    pairs: int = 0
    raw_px: float = math.nan
    left_px: float = math.nan
    best_px: float = math.nan
    error_px: float = math.nan
    rivals_px: Mapping[str, float] = field(default_factory=dict)
    suspects: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def is_right(self) -> bool:
        """Whether nothing is wrong, as far as can be told."""
        return self.verdict == "right"

    @property
    def is_wrong(self) -> bool:
        """Whether something is, named or not."""
        return self.verdict in ("wrong", "something is wrong")

    def __str__(self) -> str:
        lines = [f"{self.verdict}: {self.words}"]
        if self.pairs:
            rows = {"as recorded": self.left_px, "with the best motion": self.best_px}
            ranked = sorted(self.rivals_px.items(), key=lambda row: row[1])
            rows |= {name.partition("=[")[0]: px for name, px in ranked[:5] if self.is_wrong}
            lines += [f"  {name:52} leaves {px:8.3f} px" for name, px in rows.items()]
            lines.append(f"  median flow {self.raw_px:.2f} px, {self.pairs} pairs of frames")
        if self.unseen:
            lines.append(f"  would not show if it was needed: {', '.join(self.unseen)}")
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


def diagnosed(
    pairs: Pairs, rivals: Sequence[Rival], names: Sequence[str],
    instruction: Callable[[str, Pairs], str], frozen: Sequence[str] = (),
) -> Diagnosis:  # fmt: skip
    """Returns the verdict on pairs that move.

    Args:
        names: the names of the frames.
        instruction: tells the user what to do, given `Rival.remedy` and the corrected pairs.
        frozen: the names of further frames, whose recorded standstill the data contradict.
    """
    competition = _Competition(pairs, rivals)
    recorded, others = competition.recorded, competition.others
    pairs, noise, flow_px = recorded.pairs, competition.noise, competition.flow_px
    tolerated = max(_HARMLESS_PX, _HARMLESS * flow_px)
    if pairs.is_estimated:  # whose errors are alike in all pictures, so that they don't average out
        tolerated = 2 * (_HARMLESS_PX + _HARMLESS * flow_px)
    gains = {each: each.nats - recorded.nats for each in others}
    effects = {each: each.effect_px(recorded) for each in others}
    ranked = sorted(gains, key=lambda each: -gains[each])
    best_px = noise.typical_px
    error_px = deviation_px = resolution_px = 0.0
    if recorded.poses is not None:
        deviation_px = median(recorded.poses.y.norm(dim=-1))
        variance = recorded.poses.cov.diagonal(dim1=-2, dim2=-1).sum(-1)
        # Of P pairs: the noise of poses that the deviations allow is about sigma / P^(1/4).
        resolution_px = 2 * median(variance.sqrt()) / len(pairs.K) ** 0.25
        deviation_px = math.sqrt(max(deviation_px**2 - median(variance), 0.0))
        # What the data do not refute may be so.
        likely = [e for e in others if gains[e] > -3]
        hidden = [  # of two rough motions, less their noise
            math.sqrt(
                max(effects[e] ** 2 - 2 * (e.rival.subject == "poses") * deviation_px**2, 0.0)
            )
            for e in likely
        ]
        hidden += [
            competition.rule_px * (competition.rule_nats > 0),
            competition.trend_px * (competition.trend_nats > 0),
        ]
        error_px = max(math.hypot(deviation_px, resolution_px), *hidden)
    first = ranked[0] if ranked else None
    named = next((each for each in ranked if not each.rival.is_vague), None)
    if first is not None and named is not None and gains[named] > _MOSTLY * gains[first]:
        first = named  # the rest may be a second mistake
    if flow_px < _HARDLY_PX:  # a camera at rest, whose poses are noise
        tolerated = max(tolerated, _NOISY_RAD * pairs.focal_px)
    unlisted = [
        (what, px)
        for what, px, nats in (
            ("errors of poses that follow a rule", competition.rule_px, competition.rule_nats),
            ("a trend of the residuals", competition.trend_px, competition.trend_nats),
        )
        if nats > _SURE and px > tolerated
    ]
    # With an unlisted mistake for certain, it is the listed one that explains the most.
    least = tolerated / 2 if unlisted else tolerated
    is_explained = first is not None and gains[first] > _SURE and effects[first] > least
    alike = [
        e
        for e in ranked
        if first is not None
        and is_explained
        and gains[e] > gains[first] - 3
        and e.rival.is_vague == first.rival.is_vague
    ]
    fewest = {e.rival.subject: len(e.n) for e in sorted(alike, key=lambda e: -len(e.n))}
    alike = [each for each in alike if len(each.n) <= fewest[each.rival.subject] + 1]
    width = pairs.now.shape[-1]
    texts = [each.rival.texts(each.n, width) for each in alike]
    rest_px = {
        each.rival.texts(each.n, width)[0]: _left_px(each.pairs, each.motion) for each in ranked
    }
    numbers: dict[str, Any] = {
        "pairs": len(pairs.K), "raw_px": flow_px, "best_px": best_px, "error_px": error_px,
        "left_px": _left_px(pairs, recorded.motion), "rivals_px": rest_px,
        "suspects": tuple(remedy for remedy, _ in texts),
    }  # fmt: skip
    size = f"flow: {flow_px:.2g} px"
    is_doubtful = pairs.by_flow and best_px > _UNSURE * flow_px + 3 * _HARMLESS_PX
    if is_doubtful and pairs.is_estimated:
        why = (
            f"flow estimated from the pictures is too poor: its noise is {best_px:.2g} px ({size})"
        )
        return Diagnosis("can't tell", why + "; a finer flow.preset may do better", **numbers)
    if texts and alike[0].rival.is_vague:
        why = f"{texts[0][1]}, which changes flow by {effects[alike[0]]:.2g} px ({size}), and none "
        why += f"of {len(rivals)} known mistakes explains it better"
        return Diagnosis("something is wrong", why, **{**numbers, "suspects": ()})
    if texts:
        ways = " or ".join(
            f"{said} ({instruction(remedy, each.pairs)} would change flow by "
            f"{effects[each]:.2g} px)"
            for each, (remedy, said) in zip(alike, texts)
        )
        return Diagnosis("wrong", f"{ways}; {size}", **numbers)
    if unlisted:
        what, px = unlisted[0]
        why = f"{what}, {px:.2g} px ({size}), and none of {len(rivals)} known mistakes explains it"
        return Diagnosis("something is wrong", why, **numbers)
    notes, count = [], len(names) + len(frozen)
    if recorded.poses is not None:
        most = max(_NOISY * flow_px, _NOISY_RAD * pairs.focal_px, tolerated)
        is_world = recorded.shown.shares.amax(0) > _MOST
        if (
            deviation_px > most
            and deviation_px > 2 * resolution_px
            and is_world.double().mean() > 0.5
        ):
            why = f"the recorded motion is {deviation_px:.2g} px from that of the pictures ({size})"
            why += f", and none of {len(rivals)} known mistakes explains it"
            return Diagnosis("something is wrong", why, **numbers)
        off = recorded.poses.y.norm(dim=-1)
        sigma = recorded.poses.cov.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
        is_bad = (
            recorded.poses.is_bad
            & is_world
            & (off > 3 * sigma)
            & (off > max(4 * deviation_px, 2 * tolerated, _NOISY_RAD * pairs.focal_px))
        )
        bad = [*(name for name, is_one in zip(names, is_bad.tolist()) if is_one), *frozen]
        if len(bad) >= max(3, _MANY_BAD_PAIRS * count):
            why = f"poses of {len(bad)} in {count} pairs don't fit: {', '.join(bad)}"
            return Diagnosis("something is wrong", why, **numbers)
        if bad:
            notes.append(f"poses that don't fit the others: {', '.join(bad)}")
    if error_px > max(_UNSURE * flow_px, _HARMLESS_PX):
        why = f"errors of up to {error_px:.2g} px would not show ({size})"
        return Diagnosis("can't tell", why, **numbers)
    if recorded.poses is None:
        notes.append("poses and the unit of depth are not tested")
    elif deviation_px > max(2 * resolution_px, tolerated):
        notes.append("the poses are rough: motion estimated from flow and depth fits better")
    outliers = 1 - float(recorded.shown.shares.amax(0).mean())
    if outliers > _MANY_OUTLIERS and pairs.by_flow:
        notes.append(f"{outliers:.0%} of pixels don't fit: they move, or depth is wrong there")
    parts = "raw flow, " * pairs.by_flow + "depth, K" + ", the camera's motion" * pairs.has_poses
    agree = f"{parts} agree to within {error_px:.2g} px ({size}), beside noise of {best_px:.2g} px"
    unseen = _unseen(pairs, rivals, max(error_px, tolerated)) if pairs.has_poses else ()
    return Diagnosis("right", agree, **numbers, unseen=unseen, notes=tuple(notes))


def _left_px(pairs: Pairs, motion: Tensor) -> float:
    return median(length(residuals(pairs, motion)).nanmedian(-1).values)


class _Competition:
    """The explanations of some pairs, with one noise for all."""

    def __init__(self, pairs: Pairs, rivals: Sequence[Rival]) -> None:
        if not pairs.by_flow and pairs.has_poses:
            # What the recorded motion takes out of the picture is no evidence against it.
            seen = residuals(pairs, pairs.motion)[:, 0].isfinite()
            is_most = seen.sum(-1, keepdim=True) > 0.5 * (~pairs.depth.isnan()).sum(
                -1, keepdim=True
            )
            pairs = pairs._replace(depth=pairs.depth.masked_fill(~seen & is_most, math.nan))
        self.pairs, self.outliers = pairs, model.outlier_density(pairs)
        none = pairs.depth[:, :0]
        rivals = [r for r in rivals if pairs.has_poses or r.subject != "poses"]
        closed = [
            r.change(pairs, none).motion for r in rivals if r.subject == "poses" and not r.start[0]
        ]
        starts = self._starts(closed)
        noise = self._noise(pairs, starts)
        starts = torch.cat([fit.refined(pairs, starts[:-1], noise.px), starts[-1:]])
        noise = self._noise(pairs, starts)
        shown = model.mixture(pairs, starts, noise, self.outliers)
        noise = model.learnt_noise(pairs, self._rest(pairs, starts, shown))
        best = flow_of(pairs, model.best_of(shown))
        self.flow_px = median(length(pairs.raw if pairs.by_flow else best).nanmedian(-1).values)
        pairs = self.pairs = pairs._replace(smooth=_smooth(pairs, shown))
        # The rivals that fit best if poses are exact; those that change the data then show the
        # noise, of which the least is the one that any explanation has to explain.
        own = pairs.motion if pairs.has_poses else model.best_of(shown)
        known = torch.where(own.isfinite(), own, EYE)
        tried = []
        for rival in rivals:
            fitted = fitted_numbers(pairs, rival, known, noise.px)
            if fitted is not None:
                tried.append((rival, *fitted))
        data = sorted((t for t in tried if t[0].subject != "poses"), key=lambda t: t[2])
        # Without poses, the motion that a correction makes fit isn't known yet: all compete.
        data = data[:_SCORED] if pairs.has_poses else data
        kept: list[tuple[Any, ...]] = []
        for rival, n, _ in [*(t for t in tried if t[0].subject == "poses"), *data]:
            changed = rival.change(pairs, n)
            if rival.subject == "poses":
                kept.append((rival, n, changed, None, None))
                continue
            everything = torch.ones_like(changed.depth, dtype=torch.bool)
            motion = changed.motion
            if not pairs.has_poses:
                motion = motion_of_points(*_points(changed), everything)
            others = torch.cat([motion.unsqueeze(0), model.best_of(shown).unsqueeze(0)])
            motions = torch.cat([fit.refined(changed, others, noise.px, 4), motion.unsqueeze(0)])
            kept.append((rival, n, changed, motions, self._noise(changed, motions)))
        rest = self._rest(pairs, starts, shown)
        smooth = model.without_trend(pairs, rest, noise)
        noises: list[Noise] = [
            noise,
            model.learnt_noise(pairs, smooth),
            *(k[-1] for k in kept if k[-1]),
        ]
        self.noise = noise = min(noises, key=lambda each: float(each.px.log().mean()))
        shown = model.mixture(pairs, starts, noise, self.outliers)
        by = model.metric(pairs, shown, noise)
        self.recorded = self._explained(_NO_RIVAL, none, pairs, shown, by)
        # The data as recorded compete with the same motions as corrections of the data do, too.
        few = torch.cat([starts[-2:-1], model.best_of(shown).unsqueeze(0), known.unsqueeze(0)])
        same = model.mixture(pairs, few, noise, self.outliers)
        again = self._explained(_NO_RIVAL, none, pairs, same, model.metric(pairs, same, noise))
        if again.nats > self.recorded.nats:
            self.recorded, shown, starts = again, same, few
        by = model.metric(pairs, shown, noise)
        self.others = [
            self._explained(rival, n, changed, shown, by)
            for rival, n, changed, motions, _ in kept
            if motions is None
        ]
        for rival, n, changed, motions, _ in kept:
            if motions is not None:
                other = model.mixture(changed, motions, noise, self.outliers)
                each = self._explained(
                    rival, n, changed, other, model.metric(changed, other, noise)
                )
                self.others.append(each)
        # Poses between two recorded ones have less noise: only what the opposite time doesn't gain
        # speaks for a delay.
        for i, each in enumerate(self.others):
            if each.rival.is_of_time:
                n = -each.n.expand(len(pairs.K), -1)
                back = self._explained(each.rival, n, each.rival.change(pairs, n), shown, by)
                self.others[i] = replace(each, handicap=max(back.nats - self.recorded.nats, 0.0))
        self.rule_px = self.rule_nats = 0.0
        of_poses = self.recorded.poses
        if of_poses is not None and len(pairs.K) >= 8:
            rule = model.by_a_rule(self.recorded)
            after = self._poses(pairs.motion, shown, by, rule)
            self.rule_px = median(rule.norm(dim=-1))
            self.rule_nats = float((after.nats - of_poses.nats).nansum())
        rest = self._rest(pairs, starts, shown)
        if (
            of_poses is not None
        ):  # of the pixels that follow the recorded motion alone, if they are many
            at = of_poses.mode, torch.arange(len(pairs.K))
            of_mode = shown.odds[at] * (shown.shares[at] > 0.3).unsqueeze(-1)
            rest = torch.where(of_mode.unsqueeze(1) > 0.5, rest, math.nan)
        smooth = model.without_trend(pairs, rest, noise)
        gain = torch.log1p((length(rest) / noise.px).square() / 4) - torch.log1p(
            (length(smooth) / noise.px).square() / 4
        )
        self.trend_nats = 3.0 * float(gain.nansum()) / noise.together
        self.trend_px = median(length(rest - smooth).nanmedian(-1).values)

    def _rest(self, pairs: Pairs, motions: Tensor, shown: model.Mixture) -> Tensor:
        """Returns the residuals `[P, C, N]` of each pixel's likeliest motion, nan of outliers."""
        rest, likely = residuals(pairs, motions), shown.odds.max(0)
        rest = rest.gather(0, likely.indices[None, :, None].expand(1, -1, rest.shape[2], -1))[0]
        return torch.where(likely.values.unsqueeze(1) > 0.3, rest, math.nan)

    def _noise(self, pairs: Pairs, motions: Tensor) -> Noise:
        """Returns the noise of the motion that leaves least of most pixels."""
        rest = residuals(pairs, motions)
        near = length(rest).nanquantile(0.2, -1).nan_to_num(math.inf).argmin(0)
        return model.learnt_noise(pairs, rest[near, torch.arange(len(near))])

    def _starts(self, closed: Sequence[Tensor]) -> Tensor:
        """Returns motions `[M, P, 4, 4]` that pictures may show, the recorded one last."""
        pairs = self.pairs
        still = EYE.expand(len(pairs.K), 4, 4)
        known = [pairs.motion, *closed, still] if pairs.has_poses else [still]
        known = [torch.where(each.isfinite(), each, EYE) for each in known]
        size = length(residuals(pairs.few, torch.stack(known)))
        rank = size.nanquantile(0.4, -1).nan_to_num(math.inf).argmin(0)
        nearest = torch.stack(known)[rank, torch.arange(len(still))]
        starts = [nearest, *[still] * (not pairs.by_flow), known[0], known[0]]
        if pairs.by_flow:
            left = torch.ones_like(pairs.depth, dtype=torch.bool)
            for _ in range(2):
                found = motion_of_points(*_points(pairs), left)
                starts.insert(0, found)
                size = length(residuals(pairs, found))
                left = left & ~(size < 3 * size.nanquantile(0.2, -1, keepdim=True))
        return torch.stack(starts)

    def _poses(
        self, motion: Tensor, shown: model.Mixture, by: Metric, correction: Any = 0.0
    ) -> model.Poses:
        least = 1e-3 if self.pairs.by_flow else 1e-2
        most = max(_NOISY * self.flow_px, _NOISY_RAD * self.pairs.focal_px, 2 * least)
        return model.poses(motion, shown, by, self.flow_px, least, most, correction)

    def _explained(
        self, rival: Rival, n: Tensor, pairs: Pairs, shown: model.Mixture, by: Metric
    ) -> Explanation:
        of = self._poses(pairs.motion, shown, by) if self.pairs.has_poses else None
        return Explanation(rival, n.nanmedian(0).values, pairs, shown, of)


_NO_RIVAL = Rival("poses", "", "", lambda pairs, n: pairs)


def _smooth(pairs: Pairs, shown: model.Mixture) -> Tensor:
    """Returns raw flow without its noise, where a motion explains it."""
    flow = flow_of(pairs, torch.where(shown.motions.isfinite(), shown.motions, EYE))
    likely = shown.odds.max(0)
    flow = flow.gather(0, likely.indices[None, :, None].expand(1, -1, 2, -1))[0]
    raw = torch.linalg.solve(pairs.gain, pairs.raw)
    return torch.where(likely.values.unsqueeze(1) > 0.5, flow, raw)


def _points(pairs: Pairs) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns rays [P, 3, N], inverse depth, the flow that K's change doesn't cause, and K."""
    rays = torch.linalg.inv_ex(pairs.K)[0] @ fit.homogeneous(pairs.pixel)
    moved = (pairs.prev_K @ rays)[:, :2] - (pairs.pixel - torch.linalg.solve(pairs.gain, pairs.raw))
    return rays, pairs.depth.reciprocal(), moved, pairs.prev_K


def _unseen(pairs: Pairs, rivals: Sequence[Rival], least: float) -> tuple[str, ...]:
    """Returns the corrections whose usual mistake would not change the residuals here."""
    pairs, unseen = pairs.few, []
    now = residuals(pairs, pairs.motion)
    for rival in rivals:
        if len(rival.usual) == len(rival.start[0]):
            other = rival.change(pairs, now.new_tensor(rival.usual).expand(len(now), -1))
            apart = length(residuals(other, other.motion) - now)
            if median(apart.nanmedian(-1).values) <= least:
                unseen.append(rival.remedy.partition("={")[0].partition("=[")[0].partition(" {")[0])
    return tuple(unseen)
