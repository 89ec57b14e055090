"""The verdict on pairs of frames: their residuals as recorded, and as each rival corrects them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import torch
from torch import Tensor

from flowrep.diagnosis import fit
from flowrep.diagnosis.fit import EYE, INTERPOLATED_PX, Pairs, median, quantile_px, residuals
from flowrep.diagnosis.rivals import Rival

# An error counts if it is larger than each of these.
_EXACT_PX = 2e-3  # the data's rounding
_OF_NOISE = 0.3  # of the noise
_OF_ESTIMATED = 0.03  # of the flow's length, if it was estimated: it is then too short
# An explanation makes errors several times smaller, or clearly smaller in most of many pairs.
_SEVERAL = 3.0  # times
_CLEARLY = 1.7  # times
_MANY_PAIRS = 8  # least number of pairs that a linear correction of all poses is fitted to
# Shares of the flow's length.
_STRUCTURED = 0.1  # residuals with more structure than this don't come from flow's estimator
_LARGE = 0.04  # a larger error is explained if it becomes clearly smaller, not several times
_EXPLAINED = 0.25  # the largest error that an explanation may leave
_UNSURE = 0.15  # with a larger error, even "right" would be too inaccurate to be of use
# The noise of poses causes errors up to the sum of a share of the flow's length and one of the
# picture's width, ...
_ROUGH = 0.25
_ROUGH_WIDTHS = 1 / 1280
# ... but none that exceed both a multiple of the flow's noise and a share of the flow's length.
_TIMES_THE_NOISE = 20.0
_LITTLE = 0.02
# The estimator of flow has failed if the residual of the best motion is more than the sum of this
# share of the flow's length and these pixels.
_DOUBTFUL = 0.15
_DOUBTFUL_PX = 0.15
# The poses of a pair are outliers if their error is more than both of these.
_OUTLYING_PAIR_TIMES = 4.0  # times the usual error
_OUTLYING_PAIR_SHARE = 0.04  # of the pair's flow
_MANY_OUTLYING_PAIRS = 0.2  # of all pairs: then a part of the recording is wrong
# A pixel is an outlier if its residual is more than both of these.
_OUTLIER_SCALES = 3.0  # scales of the pair's residuals, see `fit.scale_of`
_OUTLIER_PX = 0.1  # for pairs that have hardly any noise
_MANY_OUTLIERS = 0.03  # of all pixels: a note then gives their share
# Outliers that fit if the largest depth is added to theirs.
_WRAPPED_SHARE = 0.02  # of all pixels: a note then gives their share
_MANY_WRAPPED = 0.1  # of all pixels: depth is then wrong
_WRAPPED_EDGES = 5e-4  # edges between far and near, per pixel: with fewer, depth doesn't wrap
# Pixels whose flow fits the motion between maps of depth, over those that fit flow's best motion.
# Above this, the motion between maps of depth may be a crowd's.
_CROWD = 0.5
_FARTHEST = 0.03  # of all pixels: if more are at the largest depth, it may mean "unknown"
# A fitted factor beyond these, or below their inverse, is no camera's and no unit's.
_LARGEST_FACTORS = {"camera": 30.0, "depth": 1e5}


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
    pairs: Pairs, starts: Sequence[Tensor], rivals: Sequence[Rival], names: Sequence[str],
    instruction: Callable[[str, Pairs], str], frozen: Sequence[str] = (),
) -> Diagnosis:  # fmt: skip
    """Returns the verdict on pairs that move.

    Args:
        starts: motions `[P, 4, 4]` that the best one may be near to.
        names: the names of the frames.
        instruction: tells the user what to do, given `Rival.remedy` and the corrected pairs.
        frozen: the names of further frames, whose recorded standstill the data contradict.
    """
    recorded, others = _fits(pairs, starts, rivals)
    width, motion = pairs.now.shape[-1], pairs.motion if pairs.has_poses else recorded.motion
    ego = pairs.pixel - fit.seen_before(pairs, motion)[0]
    flow_px = quantile_px(pairs.raw if pairs.by_flow else ego)
    raw_px = median(flow_px)
    noise = torch.stack([e.spread for e in (recorded, *others)]).nan_to_num(math.inf).amin(0)
    errors, least = recorded.beyond(noise, recorded.significant), recorded.least
    error = median(errors)
    best_px = median(quantile_px(residuals(pairs, recorded.motion, plain=True)))
    explanations = _explanations(others, errors, noise, raw_px) if error > least else []
    texts = [each.rival.texts(each.n, width) for each in explanations]
    numbers: dict[str, Any] = {
        "pairs": len(errors), "raw_px": raw_px, "best_px": best_px, "error_px": error,
        "left_px": median(quantile_px(residuals(pairs, motion, plain=True))),
        "rivals_px": {each.rival.texts(each.n, width)[0]: each.residual_px for each in others},
        "suspects": tuple(remedy for remedy, _ in texts),
    }  # fmt: skip
    ways = " or ".join(
        f"{description} ({instruction(remedy, each.pairs)} would reduce the error to "
        f"{median(each.beyond(noise)):.2g} px)"
        for each, (remedy, description) in zip(explanations, texts)
    )
    size = f"{error:.2g} px (flow: {max(raw_px, median(quantile_px(ego))):.2g} px)"
    is_doubtful = pairs.is_estimated and best_px > _DOUBTFUL * raw_px + _DOUBTFUL_PX
    first = explanations[0] if explanations else None
    if is_doubtful and (not first or len(first.n)):  # numbers fitted to such flow explain nothing
        why = f"flow estimated from the pictures fits no motion: the residual is {best_px:.2g} px"
        return Diagnosis("can't tell", why, **numbers)
    enough = max(2 * first.least, error / _SEVERAL) if first else 0.0
    if first and median(first.beyond(noise)) < enough and not first.is_unexplained:
        return Diagnosis("wrong", f"{ways}; now it is {size}", **numbers)
    exceeds_noise = error > _ROUGH * raw_px + _ROUGH_WIDTHS * width
    exceeds_noise |= error > max(_TIMES_THE_NOISE * median(recorded.spread), _LITTLE * raw_px)
    if first or recorded.is_unexplained or (exceeds_noise and error > least):
        why = f"the error is {size}, and none of {len(rivals)} known mistakes explains it"
        why += f"; the best motion has a residual of {best_px:.2g} px" if pairs.has_poses else ""
        why += f"; nearest: {ways}" if first else ""
        return Diagnosis("something is wrong", why, **numbers)
    if pairs.by_flow and (why := _depth_of_another_time(recorded, raw_px)):
        return Diagnosis("something is wrong", why, **numbers)
    usual = max(median(recorded.significant), least)
    most = (_OUTLYING_PAIR_SHARE * flow_px).clamp(min=_OUTLYING_PAIR_TIMES * usual)
    is_outlying, count = (recorded.significant > most).tolist(), len(names) + len(frozen)
    outlying = [*(name for name, is_one in zip(names, is_outlying) if is_one), *frozen]
    if len(outlying) >= max(3, _MANY_OUTLYING_PAIRS * count):
        why = f"poses of {len(outlying)} in {count} pairs don't fit: {', '.join(outlying)}"
        return Diagnosis("something is wrong", why, **numbers)
    if not pairs.by_flow:
        hidden = median(pairs.K[:, 0, 0] * quantile_px(pairs.coarseness.unsqueeze(1), 0.5))
        error = numbers["error_px"] = max(error, hidden)
        size = f"{error:.2g} px (flow: {raw_px:.2g} px)"
    steps = f"depth's steps of {pairs.depth_step:.2g} m hide"
    if error > _UNSURE * raw_px:
        why = f"{steps} errors of {size}: give flow, too"
        if not pairs.is_coarse:
            why = f"the error is {size}: rough poses, or a mistake that {len(errors)} pairs hide"
        return Diagnosis("can't tell", why, **numbers)
    why, of_depth = _about_depth(pairs, motion)
    if why:
        return Diagnosis("something is wrong", why, **numbers)
    notes = [*[f"{steps} smaller errors"] * pairs.is_coarse, *of_depth]
    if outlying:
        notes.append(f"poses that don't fit the others: {', '.join(outlying)}")
    if not pairs.has_poses:
        notes.append("poses and the unit of depth are not tested")
    elif best_px < numbers["left_px"] / 2 and error > raw_px / 10:
        notes.append("the poses are rough: motion estimated from flow and depth fits better")
    parts = "raw flow, " * pairs.by_flow + "depth, K" + ", the camera's motion" * pairs.has_poses
    agree = f"{parts} agree to {size}, beside noise of {best_px:.2g} px"
    unseen = _unseen(pairs, rivals, max(least, error)) if pairs.has_poses else ()
    return Diagnosis("right", agree, **numbers, unseen=unseen, notes=tuple(notes))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Errors of the data, as they are or as a rival corrects them, px `[P]`.

    `error` is the difference between the recorded motion and the best one, `spread` the median
    residual of the best one, estimated as if it were noise.
    """

    rival: Rival
    n: Tensor  # [k]
    pairs: Pairs
    motion: Tensor  # the best
    error: Tensor
    spread: Tensor

    def beyond(self, noise: Tensor, error: Tensor | None = None) -> Tensor:
        """Returns the motion's errors, combined with the part of the spread that exceeds noise."""
        error = self.error if error is None else error
        return (error.square() + (self.spread.square() - noise.square()).clamp(min=0)).sqrt()

    @property
    def residual_px(self) -> float:
        """The median of error and spread combined."""
        return median(self.beyond(0 * self.spread))

    @property
    def least(self) -> float:
        """The least error that counts."""
        pairs = self.pairs
        bias = _OF_ESTIMATED * median(quantile_px(pairs.raw)) if pairs.is_estimated else 0.0
        return max(self.floor, bias, 0.0 if pairs.by_flow else INTERPOLATED_PX)

    @cached_property
    def floor(self) -> float:
        """The least difference of errors that counts, by how far halves of the picture differ."""
        halves_px = _SEVERAL * median(fit.difference_px(self.pairs, *self.halves[1])) / 2
        return max(_EXACT_PX, halves_px, _OF_NOISE * median(self.spread))

    @cached_property
    def halves(self) -> tuple[list[Pairs], list[Tensor]]:
        """The pairs with either half of their pixels, and the best motions of each.

        A half is every other block of the picture, since neighbouring pixels have similar errors.
        """
        pairs, is_even = self.pairs, _every_other(self.pairs, *fit.PARTS)
        halves = [
            pairs._replace(depth=pairs.depth.masked_fill(half, math.nan))
            for half in (is_even, ~is_even)
        ]
        return halves, [fit.best_motion(half, self.motion) for half in halves]

    @cached_property
    def significant(self) -> Tensor:
        """The errors where they are no noise, else 0.

        They are no noise if the best motion is better for pixels to which it was not fitted: in
        most pairs, or else in both halves of a pair.
        """
        if not self.pairs.has_poses:
            return self.error
        agree = []
        for half, motion in zip(self.halves[0], self.halves[1][::-1]):
            residuals_px = residuals(half, torch.stack([self.pairs.motion, motion]))
            agree.append(fit.agreement(half, residuals_px).mean(-1))
        better = torch.stack([now < then for now, then in agree])
        count = better.numel()
        by_no_chance = 2 * int(better.sum()) - count > 2 * count**0.5
        return torch.where(better.all(0) | by_no_chance, self.error, 0.0)

    @property
    def is_unexplained(self) -> bool:
        """Whether residuals or errors can be predicted, and so are no noise."""
        least, noise = self.least, _without_trend(self.pairs, self.motion)
        structure = median((self.spread.square() - noise.square()).clamp(min=0).sqrt())
        if structure > least:
            is_large = structure > _STRUCTURED * median(quantile_px(self.pairs.raw))
            share = median(noise) / max(median(self.spread), 1e-12)
            if share < 1 / _SEVERAL or (is_large and is_better(noise, self.spread)):
                return True
        if len(noise) < _MANY_PAIRS or not median(self.significant) > least:
            return False
        return is_better(_after_linear_correction(self.pairs, self.motion), self.significant)


def is_better(after: Tensor, before: Tensor) -> bool:
    """Whether errors `[P]` are several times less than others, or clearly less in most pairs."""
    share = median(after) / max(median(before), 1e-12)
    better = int((after < before / 1.1).sum())
    # That is 8 of 8 pairs, or 16 of 19. Chance alone does it in one of 200 cases.
    by_no_chance = 2 * better - len(after) > 2.6 * len(after) ** 0.5
    return share < 1 / _SEVERAL or (share < 1 / _CLEARLY and by_no_chance)


def _fits(
    pairs: Pairs, starts: Sequence[Tensor], rivals: Sequence[Rival]
) -> tuple[_Fit, list[_Fit]]:
    """Returns the errors of the data as they are, and as each rival that may help corrects them."""
    few, none = pairs.select(pixels=slice(fit.FITTED)), pairs.depth[:, :0]
    has_poses = pairs.has_poses
    still = EYE.expand(len(none), 4, 4)
    starts = [*starts, still]
    if has_poses:
        of_poses = [r for r in rivals if r.subject == "poses" and not r.start[0]]
        known = [pairs.motion, *(rival.change(pairs, none).motion for rival in of_poses)]
        starts = [pairs.motion, fit.least_costly(pairs, torch.stack(known)), *starts]

    best = fit.best_motion(pairs, *starts, steps=8)
    is_crowd = torch.zeros(len(none), dtype=torch.bool)
    if has_poses and pairs.by_flow:  # a motion that fits a crowd is no evidence against poses
        is_crowd = fit.fits_a_crowd(pairs, residuals(pairs, best))
        best = torch.where(is_crowd[:, None, None], pairs.motion, best)
    recorded, others = fitted(pairs, best, has_poses), []
    if has_poses and recorded.residual_px < (_EXACT_PX if pairs.by_flow else INTERPOLATED_PX):
        return recorded, []
    motion = pairs.motion if has_poses else recorded.motion
    recorded_px = median(quantile_px(residuals(few, motion)))
    for rival in rivals if has_poses else [rival for rival in rivals if rival.subject != "poses"]:
        n = _fitted_numbers(few, rival, recorded.motion)
        if n is None:
            continue
        changed, motion = rival.change(pairs, n), recorded.motion
        if not has_poses:
            motion = fit.best_motion(changed, still, motion)
        elif rival.subject != "poses":
            # Except for poses, a correction that increases the residuals explains nothing.
            few_changed = changed.select(pixels=slice(fit.FITTED))
            if not median(quantile_px(residuals(few_changed, changed.motion))) <= recorded_px:
                continue
            motion = fit.best_motion(changed, changed.motion)
        other = fitted(changed, motion, has_poses, rival, n)
        if is_crowd.any():  # nor does a rival that fits the crowd
            fits_it = is_crowd & fit.fits_a_crowd(pairs, residuals(changed, motion))
            other = replace(other, spread=other.spread.masked_fill(fits_it, math.inf))
        others.append(other)
    return recorded, others


def fitted(
    pairs: Pairs, motion: Tensor, has_poses: bool, rival: Rival | None = None,
    n: Tensor | None = None,
) -> _Fit:  # fmt: skip
    """Returns the errors of pairs, given the best motion, and a rival's numbers `[P, k]`."""
    # A rival may need a pose beyond the recording's ends: the error there is unknown.
    none, error = pairs.depth[:, :0], fit.difference_px(pairs, pairs.motion, motion)
    if not has_poses:  # the best motion is as good as any
        error = torch.zeros_like(error)
    rival = rival or Rival("poses", "", "", lambda pairs, n: pairs)
    n = none if n is None else n
    spread = fit.spread_of(residuals(pairs, motion))
    return _Fit(rival, n.nanmedian(0).values, pairs, motion, error, spread)


def _fitted_numbers(few: Pairs, rival: Rival, best: Tensor) -> Tensor | None:
    """Returns a rival's numbers `[P, k]`, fitted to the other half of the pairs.

    None if there are too few pairs, or if a factor is too large or too small.
    """
    count, k = len(best), len(rival.start[0])
    if not k:
        return best.new_zeros(count, 0)
    if count < 4 and k > 2:
        return None
    every, tries = torch.arange(count), []
    half = every % 2 if count >= 4 else 0 * every
    group = every if rival.per_pair else half
    for start in rival.start:
        n = best.new_tensor(start).expand(int(group.max()) + 1, k)
        known = None if few.has_poses else best
        motion, n = fit.gauss_newton(few, known, rival.change, n, group, steps=7)
        residuals_px = residuals(rival.change(few, n[group]), motion)
        each_px = quantile_px(residuals_px).nan_to_num(math.inf)
        tries.append((n, [float(each_px[half == i].median()) for i in half.unique()]))
    if rival.per_pair:
        # A frame's number is taken from the fit to the other pair that has this frame.
        follows = (few.path[1:, 1] == few.path[:-1, 2]).flatten(1).all(1)
        if not follows.any():
            return None
        frames, n = n, n.clone()
        n[:-1, 0] = torch.where(follows, frames[1:, 1], frames[:-1, 0])
        n[1:, 1] = torch.where(follows, frames[:-1, 0], frames[1:, 1])
    else:
        halves = [min(tries, key=lambda tried: tried[1][i])[0][i] for i in half.unique()]
        n = torch.stack(halves)[half.max() - half]
    if rival.in_pixels:
        n = (n * few.now.shape[-1]).round() / few.now.shape[-1]
    first, most = best.new_tensor(rival.start[0]), _LARGEST_FACTORS.get(rival.subject, math.inf)
    factors = n[:, first != 0] / first[first != 0]
    return n if bool(((factors > 1 / most) & (factors < most)).all()) else None


def _explanations(
    others: Sequence[_Fit], before: Tensor, noise: Tensor, raw_px: float
) -> list[_Fit]:
    """Returns the rivals that explain errors, the best first."""
    after = {each: median(each.beyond(noise)) for each in others}
    error, ranked = median(before), sorted(others, key=lambda each: after[each])
    most = min(error, _EXPLAINED * raw_px) if error > _LARGE * raw_px else error / _SEVERAL
    good = [each for each in ranked if after[each] < most and is_better(each.beyond(noise), before)]
    if not good:
        return []
    enough = min(_CLEARLY * after[good[0]] + good[0].floor, error / _CLEARLY)
    alike = [each for each in ranked if after[each] <= enough]
    # Of several corrections of one subject, those with the fewest fitted numbers are kept.
    fewest = {each.rival.subject: len(each.n) for each in sorted(alike, key=lambda e: -len(e.n))}
    return [each for each in alike if len(each.n) == fewest[each.rival.subject]]


def _depth_of_another_time(recorded: _Fit, raw_px: float) -> str:
    """Returns how far the motion between maps of depth is from that of flow, "" if they agree."""
    of_depth = recorded.pairs._replace(by_flow=False, scale_px=0.5)
    still = EYE.expand_as(recorded.motion)
    # A motion at rest is a start, since with it no pixel leaves the picture.
    motion = fit.best_motion(of_depth, still, recorded.motion)
    px = median(fit.difference_px(recorded.pairs, motion, recorded.motion))
    known = (recorded.motion, motion, recorded.pairs.motion)
    by_flow, after, by_poses = (quantile_px(residuals(of_depth, each), 0.5) for each in known)
    # Noise of flow makes its best motion inexact where depth hardly tells motions apart, as on a
    # floor. If depth and flow agree with the same poses, they are of the same time.
    before = by_flow.minimum(by_poses.nan_to_num(math.inf))
    if px < _UNSURE * raw_px or median(before) < INTERPOLATED_PX or not is_better(after, before):
        return ""
    # A crowd that walks one way may be all that depth shows to move. Its flow then fits, too.
    residuals_px = residuals(recorded.pairs, torch.stack(known[:2]))
    shares = fit.agreement(recorded.pairs, residuals_px).mean(-1)
    if median(shares[1] / shares[0]) > _CROWD:
        return ""
    size = f"{px:.2g} px apart (flow: {raw_px:.2g} px)"
    return f"depth and flow fit different motions, {size}: were they recorded at the same time?"


def _about_depth(pairs: Pairs, motion: Tensor) -> tuple[str, list[str]]:
    """Returns how depth is wrong at its largest values, "" if it isn't, and notes on depth."""
    inverse, notes = pairs.now[pairs.now > 0], []
    farthest = float(inverse.amin().reciprocal()) if len(inverse) else 0.0
    share = float((inverse == inverse.amin()).double().mean()) if len(inverse) else 0.0
    if share > _FARTHEST:
        notes.append(f"{share:.0%} of depth is {farthest:.4g} m: if that is no surface, say so")
    if not pairs.by_flow:
        return "", notes
    outlier_share, wrapped_share = _outlier_shares(pairs, motion, farthest)
    if wrapped_share > _WRAPPED_SHARE:
        why = f"{wrapped_share:.0%} of the pixels fit if {farthest:.5g} m are added to depth"
        why += ": it wraps around there, as 16 bits of millimetres do at 65.536 m"
        if wrapped_share > _MANY_WRAPPED:
            return why, notes
        notes.append(why)
    if outlier_share > _MANY_OUTLIERS:
        notes.append(f"{outlier_share:.0%} of pixels don't fit: they move, or depth is wrong there")
    return "", notes


def _outlier_shares(pairs: Pairs, motion: Tensor, farthest: float) -> tuple[float, float]:
    """Returns the share of pixels that don't fit, and of those whose depth has wrapped around.

    A pixel has wrapped if it fits with the largest depth added, in a picture where the nearest
    pixels border on the farthest. Moving pixels may fit by chance, but have no such edges.
    """
    squared, farther = (
        residuals(each, motion).square().sum(-2)
        for each in (pairs, pairs._replace(depth=pairs.depth + farthest))
    )
    most = (_OUTLIER_SCALES * fit.scale_of(squared, pairs)).clamp(min=_OUTLIER_PX)
    most = most.square().unsqueeze(-1)
    is_outlier, number = squared > most, squared.isfinite().sum()
    side = pairs.now.reciprocal() / farthest
    side = ((side > 0.9) & (side <= 1)).long() - ((side > 0) & (side < 0.1)).long()
    edges = sum(int((side.diff(dim=dim).abs() == 2).sum()) for dim in (1, 2))
    wraps = edges > _WRAPPED_EDGES * side.numel()
    has_wrapped = is_outlier & (farther < most) & wraps
    return float(is_outlier.sum() / number), float(has_wrapped.sum() / number)


def _unseen(pairs: Pairs, rivals: Sequence[Rival], least: float) -> tuple[str, ...]:
    """Returns the corrections whose usual mistake would not change the residuals here."""
    pairs, unseen = pairs.select(pixels=slice(fit.FITTED)), []
    now = residuals(pairs, pairs.motion, plain=True)
    for rival in rivals:
        if len(rival.usual) == len(rival.start[0]):
            other = rival.change(pairs, now.new_tensor(rival.usual).expand(len(now), -1))
            if median(quantile_px(residuals(other, other.motion, plain=True) - now)) <= least:
                unseen.append(rival.remedy.partition("={")[0].partition("=[")[0].partition(" {")[0])
    return tuple(unseen)


def _every_other(pairs: Pairs, across: int, down: int) -> Tensor:
    """Returns which pixels `[P, N]` are in every other part of the picture, as on a chessboard."""
    column, row = fit.parts(pairs, across, down)
    return (column + row) % 2 == 0


def _after_linear_correction(pairs: Pairs, best: Tensor) -> Tensor:
    """Returns the errors of poses after a correction that is fitted to the other pairs, px `[P]`.

    The correction is a linear function of the motion. It reduces errors that follow a rule, such as
    those of a convention that no table lists, but not the noise of poses.
    """
    recorded, wanted = fit.motion_vector(pairs.motion), fit.motion_vector(best)
    focal, inverse = pairs.K[:, 0, 0].median(), pairs.depth.reciprocal().nanmedian()
    unit = torch.cat([focal.expand(3), (focal * inverse).expand(3)])  # all in pixels
    x, y = recorded * unit, (wanted - recorded) * unit
    x = torch.cat([x, x.norm(dim=-1).median().expand(len(x), 1) / 2.4], 1)
    # The normal equations of all pairs but one, for each.
    A = x.mT @ x - x.unsqueeze(-1) * x.unsqueeze(-2)
    b = x.mT @ y - x.unsqueeze(-1) * y.unsqueeze(-2)
    size, errors = A.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] / len(x), []
    for damping in (0.03, 0.3, 3.0):
        matrix = torch.linalg.solve_ex(A + damping * size * torch.eye(7), b)[0]
        correction = (x.unsqueeze(-2) @ matrix).squeeze(-2) / unit
        errors.append(fit.difference_px(pairs, fit.small_motion(recorded + correction), best))
    return min(errors, key=median)


def _without_trend(pairs: Pairs, best: Tensor) -> Tensor:
    """Returns the spread of the best motion's residuals without their trend, px `[P]`.

    A polynomial in the pixel's position and inverse depth is fitted to every other block of the
    picture and subtracted in the others. If K, depth and flow fit, only noise remains.
    """
    residuals_px, (height, width) = residuals(pairs, best), pairs.now.shape[-2:]
    x, y = (2 * pairs.pixel.nan_to_num() / torch.tensor([[width], [height]]) - 1).unbind(1)
    q = pairs.depth.reciprocal().nan_to_num(0.0, 0.0, 0.0).clamp(min=0.0)
    q = (q / q.median(-1, keepdim=True).values.clamp(min=1e-9)).clamp(max=3.0) - 1
    powers = [(a, b, c) for a in range(4) for b in range(4 - a) for c in range(3)]
    terms = torch.stack([x**a * y**b * q**c for a, b, c in powers], -1)
    is_even, out = _every_other(pairs, 5, 4), residuals_px
    for half in (is_even, ~is_even):
        known = half & residuals_px.isfinite().all(1)
        weight = known.double()
        for _ in range(4):
            weighted = terms * weight.unsqueeze(-1)
            A, b = weighted.mT @ terms, weighted.mT @ residuals_px.nan_to_num().mT
            A = A + torch.diag_embed(1e-3 * A.diagonal(dim1=-2, dim2=-1) + 1e-9)
            rest = residuals_px - (terms @ torch.linalg.solve_ex(A, b)[0]).mT
            squared = torch.where(known, rest.square().sum(1), math.nan)
            scale = fit.scale_of(squared, pairs).square().unsqueeze(-1)
            weight = (1 + squared / scale).square().reciprocal().nan_to_num()
        out = torch.where(half.unsqueeze(1), out, rest)
    return fit.spread_of(out)
