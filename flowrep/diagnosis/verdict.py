"""The verdict on pairs of frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from flowrep.diagnosis.explanation import CLEARLY, SEVERAL, Found, explanations, is_better
from flowrep.diagnosis.rivals import Rival
from flowrep.diagnosis.witness import Pairs, median, px_of, residual, seen_before, small_motion

# Shares of raw flow. Noise of poses reaches `_ROUGH` and a number of pixels that grows with the
# picture, unless the flow is nearly free of noise.
_LARGE = 0.04  # errors that may be explained if something leaves clearly less, not several times
_EXPLAINED = 0.25  # what an explanation leaves at most
_ROUGH, _ROUGH_WIDTHS, _TIMES_THE_NOISE, _LITTLE = 0.25, 1 / 1280, 20.0, 0.02
_UNSURE = 0.2  # right data would be right to that alone
_DOUBTFUL, _DOUBTFUL_PX = 0.15, 0.15  # left by the best motion: the flow's estimator failed
_STRAY = 6.0  # times what the median pair leaves


@dataclass(frozen=True)
class Diagnosis:
    """A verdict on the conventions of some data; printed, it is a sentence and a table.

    Attributes:
        verdict: "wrong" if listed mistakes explain the data, "something is wrong" if none does.
        words: the reason, in a sentence.
        pairs: the number of pairs of frames that were examined.
        raw_px: median length of flow.
        left_px: median of what the recorded data leave, |raw - ego| where flow is the witness.
        best_px: median of what the best motion would leave.
        error_px: how far the data are from the best explanation, without the noise: right data are
            right to this many pixels.
        rivals_px: what the data would leave, by what mends each mistake.
        suspects: what mends the data, the likeliest first; none if they are right.
        unseen: what may be needed, and would not show in these data.
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
    remedy: Callable[[str], str],
) -> Diagnosis:  # fmt: skip
    """Returns the verdict on pairs that move.

    Args:
        starts: motions `[P, 4, 4]` that the best one may be near to.
        names: the frames'.
        remedy: makes what the user types of `Rival.typed`.
    """
    recorded, others = explanations(pairs, starts, rivals)
    width, motion = pairs.now.shape[-1], pairs.motion if pairs.has_poses else recorded.motion
    ego = pairs.place - seen_before(pairs, motion)[0]
    raw_px = median(px_of(pairs.raw if pairs.by_flow else ego))
    spreads = torch.stack([each.spread for each in (recorded, *others)])
    noise = spreads.nan_to_num(math.inf).amin(0)
    errors, least = recorded.beyond(noise), recorded.least
    error, best_px = median(errors), median(px_of(residual(pairs, recorded.motion, plain=True)))
    able = _able(others, errors, noise, raw_px) if error > least else []
    texts = [_texts(each, width) for each in able]
    numbers: dict[str, Any] = {
        "pairs": len(errors), "raw_px": raw_px, "best_px": best_px, "error_px": error,
        "left_px": median(px_of(residual(pairs, motion, plain=True))),
        "rivals_px": {_texts(each, width)[0]: each.left for each in others},
        "suspects": tuple(typed for typed, _ in texts),
    }  # fmt: skip
    ways = " or ".join(
        f"{says} ({remedy(typed)} would leave {median(each.beyond(noise)):.2g} px)"
        for each, (typed, says) in zip(able, texts)
    )
    size = f"{error:.2g} px of {max(raw_px, median(px_of(ego))):.2g} px"
    is_learnt = not able or len(able[0].n) > 0
    if pairs.is_estimated and best_px > _DOUBTFUL * raw_px + _DOUBTFUL_PX and is_learnt:
        why = f"flow estimated from the pictures fits no motion: {best_px:.2g} px are left"
        return Diagnosis("can't tell", why, **numbers)
    if able and not able[0].is_unexplained:
        after = median(able[0].beyond(noise))
        if after < max(2 * able[0].least, error / SEVERAL):
            return Diagnosis("wrong", f"{ways}; now {size} are left", **numbers)
    is_rough = error > _ROUGH * raw_px + _ROUGH_WIDTHS * width
    is_rough |= error > max(_TIMES_THE_NOISE * median(recorded.spread), _LITTLE * raw_px)
    if able or recorded.is_unexplained or is_rough:
        why = f"{size} are left, which none of {len(rivals)} known mistakes explains"
        why += f"; a motion exists that would leave {best_px:.2g} px" if pairs.has_poses else ""
        why += f"; nearest: {ways}" if able else ""
        return Diagnosis("something is wrong", why, **numbers)
    if not pairs.by_flow:
        hidden = median(pairs.K[:, 0, 0] * px_of(pairs.coarseness.unsqueeze(1), 0.5))
        error = numbers["error_px"] = max(error, hidden)
        size = f"{error:.2g} px of {raw_px:.2g} px"
    if error > _UNSURE * raw_px and pairs.is_coarse:
        why = f"depth's steps of {pairs.depth_step:.2g} m hide errors of {size}: give flow, too"
        return Diagnosis("can't tell", why, **numbers)
    if error > _UNSURE * raw_px:
        why = (
            f"{size} are left, by rough poses or a mistake that doesn't show in {len(errors)} pairs"
        )
        return Diagnosis("can't tell", why, **numbers)
    notes = []
    if pairs.is_coarse:
        notes.append(f"depth has steps of {pairs.depth_step:.2g} m, which hide smaller errors")
    alone = recorded.beyond(torch.zeros_like(noise))
    most = max(_STRAY * median(alone), _ROUGH * raw_px)
    stray = [name for name, px in zip(names, alone.tolist()) if px > most]
    if stray:
        notes.append(f"poses that don't fit the others: {', '.join(stray)}")
    if not pairs.has_poses:
        notes.append("poses and the unit of depth are not tested")
    elif best_px < numbers["left_px"] / 2 and error > raw_px / 10:
        notes.append("the poses are rough: motion estimated from flow and depth leaves less")
    parts = (
        ["raw flow"] * pairs.by_flow + ["depth", "K"] + ["the camera's motion"] * pairs.has_poses
    )
    agree = f"{', '.join(parts)} agree to {size}, beside noise of {best_px:.2g} px"
    unseen = _unseen(pairs, rivals, max(least, error)) if pairs.has_poses else ()
    return Diagnosis("right", agree, **numbers, unseen=unseen, notes=tuple(notes))


def _able(others: Sequence[Found], before: Tensor, noise: Tensor, raw_px: float) -> list[Found]:
    """Returns the rivals that explain errors, the best first."""
    after = {id(each): median(each.beyond(noise)) for each in others}
    error, ranked = median(before), sorted(others, key=lambda each: after[id(each)])
    most = min(error, _EXPLAINED * raw_px) if error > _LARGE * raw_px else error / SEVERAL
    able = [each for each in ranked if after[id(each)] < most]
    able = [each for each in able if is_better(each.beyond(noise), before)]
    if not able:
        return []
    enough = min(CLEARLY * after[id(able[0])] + able[0].floor, error / CLEARLY)
    able = [each for each in ranked if after[id(each)] <= enough]
    # One that learns more numbers than another of its kind says the same with more words.
    fewest = {each.rival.of: len(each.n) for each in sorted(able, key=lambda e: -len(e.n))}
    return [each for each in able if len(each.n) == fewest[each.rival.of]]


def _unseen(pairs: Pairs, rivals: Sequence[Rival], least: float) -> tuple[str, ...]:
    """Returns what mends the mistakes of a usual size that change nothing here."""
    unseen, now = [], residual(pairs, pairs.motion, plain=True)
    for rival in rivals:
        if len(rival.usual) == len(rival.start[0]):
            usual = torch.tensor(rival.usual, dtype=torch.float64).expand(len(now), -1)
            other = rival.change(pairs, usual)
            if median(px_of(residual(other, other.motion, plain=True) - now)) <= least:
                unseen.append(rival.typed.partition("={")[0].partition("=[")[0].partition(" {")[0])
    return tuple(unseen)


def _texts(found: Found, width: int) -> tuple[str, str]:
    """Returns what mends a mistake, and what it is, with the numbers that were learnt."""
    n = [*found.n.tolist(), 0.0, 0.0]
    values: dict[str, Any] = {"inverse": 1 / n[0] if n[0] else math.inf}
    values["far"] = 1 / max(n[0] + n[1], 1e-6)
    if len(found.n) >= 2:  # the last two of some are shares of the width
        values["px"] = f"({width * n[-4]:+.1f}, {width * n[-3]:+.1f}) px"
    if len(found.n) == 6:
        values["degrees"] = math.degrees(math.hypot(*n[:3]))
        rows = small_motion(found.n)[:3].flatten().tolist()
        values["matrix"] = f"[{','.join(f'{x:.4g}' for x in rows)}]"
    return found.rival.typed.format(*n, **values), found.rival.says.format(*n, **values)
