"""The diagnosis of recorded frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from flowrep.diagnosis import fit
from flowrep.diagnosis.fit import EYE, Pairs, length, sampled
from flowrep.diagnosis.rivals import rivals_of
from flowrep.diagnosis.verdict import Diagnosis, diagnosed

# Pairs with fewer known pixels or less flow are not tested: they tell nothing.
_LEAST_PIXELS = 64
_LEAST_MOVEMENT_PX = 0.25  # median length of flow
_MANY_UNTESTED = 0.2  # of all pairs: a note then gives their number
FROZEN = "the recorded camera doesn't move, but depth changes"


@dataclass
class Examination:
    """Collects pairs of a recording's frames, and gives their diagnosis.

    Args:
        conventions: the options that the data were read with, see `Recording.conventions`.
        flow_is_recorded: whether raw flow belongs to the data. Flow that flowrep estimated has no
            options that may be wrong.
    """

    conventions: Mapping[str, str] = field(default_factory=dict)
    flow_is_recorded: bool = True
    _seen: list[tuple[Pairs, str]] = field(default_factory=list)  # name
    _reasons: list[str] = field(default_factory=list)
    _frozen: list[str] = field(default_factory=list)
    _intervals_s: list[float] = field(default_factory=list)

    @torch.no_grad()
    def add(
        self, previous: Any, current: Any, raw: Any, earlier: Any = None,
        later: Any = None,
    ) -> bool:  # fmt: skip
        """Takes two `Frame`s and the raw flow between them; returns whether they can be tested.

        Args:
            raw: `[2, H, W]`, pixels, nan where unknown.
            earlier: world_from_cam `[4, 4]` of the frame before `previous`; as `later`, of that
                after `current`, it shows whether poses are late.
        """
        flow, now, before = (torch.as_tensor(x)[None] for x in (raw, current.depth, previous.depth))
        K, prev_K = (torch.as_tensor(frame.K)[None] for frame in (current, previous))
        poses = (earlier, previous.world_from_cam, current.world_from_cam, later)
        unknown = torch.full_like(EYE, math.nan)
        path = torch.stack([unknown if p is None else torch.as_tensor(p) for p in poses])
        picture = None
        if current.rgb is not None and raw is not current.raw:
            picture = torch.as_tensor(current.rgb).movedim(-1, 0)[None]
        pairs = sampled(flow, now, before, K, prev_K, path[None], picture)
        (why,) = reasons_untestable(pairs)
        if why:
            self._reasons.append(why)
            self._frozen += [current.name] * (why == FROZEN)
            return False
        self._seen.append((pairs, current.name))
        if previous.timestamp_s is not None and current.timestamp_s is not None:
            self._intervals_s.append(current.timestamp_s - previous.timestamp_s)
        return True

    @torch.no_grad()
    def diagnosis(self) -> Diagnosis:
        """Returns the diagnosis of all pairs so far."""
        if not self._seen:
            return no_diagnosis(self._reasons)
        parts, names = zip(*self._seen)
        options = {"by_flow": True, "of_flow": self.flow_is_recorded, "absolute": True}
        rivals = rivals_of(self.conventions, **options)
        pairs = Pairs.joined(parts)
        result = diagnosed(pairs, rivals, names, self._instruction, self._frozen)
        return replace(result, notes=(*result.notes, *note_on_untested(self._reasons, len(names))))

    def _instruction(self, remedy: str, corrected: Pairs) -> str:
        words, given = remedy.split(" "), self.conventions
        numbers = corrected.K[:, [0, 1, 0, 1], [0, 1, 2, 2]]
        is_one = bool((numbers.amax(0) - numbers.amin(0) < 0.05 * numbers.amax()).all())
        if remedy.startswith(("K ", "K's", "cx", "fx")) and is_one:
            listing = ",".join(f"{number:.5g}" for number in numbers.median(0).values.tolist())
            remedy = f"intrinsics=[{listing}] first_pixel_centre=0.5"
        if remedy.startswith("depth times ") and "depth_unit_m" in given:
            remedy = f"depth_unit_m={float(words[-1]) * float(given['depth_unit_m']):.3g}"
        elif remedy.endswith(" frames later") and self._intervals_s:
            interval_s = sorted(self._intervals_s)[len(self._intervals_s) // 2]
            remedy = f"pose_offset_s={-float(words[1]) * interval_s:.3g}"
        if "=" not in remedy:
            return remedy
        options = [f"format.{option}" for option in remedy.split(" ")]
        return " ".join(options if given else ["format=frames", *options])


def reasons_untestable(pairs: Pairs) -> list[str]:
    """Returns why each pair can't be tested, "" if it can, `FROZEN` if its depth shows movement."""
    ego = length(fit.flow_of(pairs, pairs.motion)).nanmedian(-1).values.nan_to_num(0.0)
    raw = length(pairs.raw).nanmedian(-1).values.nan_to_num(0.0)
    moves = torch.maximum(raw, ego) >= _LEAST_MOVEMENT_PX
    number, has_depth = (~pairs.depth.isnan()).sum(-1), pairs.now.isfinite().flatten(1).any(1)
    is_known = has_depth & (number >= _LEAST_PIXELS)
    # While a camera stands still, depth doesn't change.
    still, frozen = (is_known & ~moves).nonzero()[:, 0], torch.zeros_like(moves)
    if len(still) and pairs.has_poses:
        few = pairs.select(still)._replace(by_flow=False)
        before = fit.residuals(few, few.motion)
        noise = torch.full_like(few.depth, _LEAST_MOVEMENT_PX)
        after = fit.residuals(few, fit.refined(few, few.motion.unsqueeze(0), noise)[0])
        now, then = (length(x).nanmedian(-1).values for x in (before, after))
        frozen[still] = (now > 2 * _LEAST_MOVEMENT_PX) & (then < now / 3)
    return [_reason(*each) for each in zip(*map(Tensor.tolist, (has_depth, number, moves, frozen)))]


def _reason(has_depth: bool, number: int, moves: bool, is_frozen: bool) -> str:
    if not has_depth:
        return "depth is nowhere known"
    if number < _LEAST_PIXELS:
        return "too few pixels are known"
    if moves:
        return ""
    return FROZEN if is_frozen else "hardly anything moves"


def note_on_untested(reasons: Sequence[str], used: int) -> list[str]:
    """Returns a note on pairs that can't be tested, if they are many; "" is no reason."""
    reasons = [why for why in reasons if why not in ("", FROZEN)]
    count = len(reasons) + used
    if len(reasons) < _MANY_UNTESTED * count:
        return []
    return [f"{len(reasons)} of {count} pairs are not tested: {max(reasons, key=reasons.count)}"]


def no_diagnosis(reasons: Sequence[str]) -> Diagnosis:
    """Returns the diagnosis if no pair can be tested."""
    why = max(reasons, key=reasons.count) if reasons else "there are no two successive frames"
    if why == FROZEN:
        return Diagnosis("something is wrong", why)
    return Diagnosis("can't tell", f"{why}; record frames in which the camera moves and turns")
