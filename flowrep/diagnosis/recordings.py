"""The diagnosis of recorded frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from flowrep.diagnosis import fit
from flowrep.diagnosis.competition import Competition
from flowrep.diagnosis.fit import EYE, Pairs, sampled
from flowrep.diagnosis.limits import FEW, FEW_PIXELS, MANY, REST_PX
from flowrep.diagnosis.mistakes import mistakes_of
from flowrep.diagnosis.verdict import Diagnosis, judged

_STILL = "hardly anything moves"


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
    _reasons: list[str] = field(default_factory=list)  # why each pair can't be tested, or ""
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
        self._seen.append((pairs, current.name))
        self._reasons.append(why)
        if previous.timestamp_s is not None and current.timestamp_s is not None:
            self._intervals_s.append(current.timestamp_s - previous.timestamp_s)
        return not why

    @torch.no_grad()
    def diagnosis(self) -> Diagnosis:
        """Returns the diagnosis of all pairs so far."""
        posed = [pairs.has_poses for pairs, _ in self._seen]
        sizes = [pairs.now.shape for pairs, _ in self._seen]  # KITTI has pictures of several
        usual = max(sizes, key=sizes.count, default=None)
        reasons = [
            "a pose is unknown" if any(posed) and not is_posed
            else "pictures have another size" if size != usual else why
            for is_posed, size, why in zip(posed, sizes, self._reasons)
        ]  # fmt: skip
        used = tested(reasons)
        if not used:
            return no_diagnosis(reasons)
        parts, names = zip(*(self._seen[i] for i in used))
        options = {"by_flow": True, "of_flow": self.flow_is_recorded, "absolute": True}
        mistakes = mistakes_of(self.conventions, **options)
        result = judged(Competition(Pairs.joined(parts), mistakes), names, self._instruction)
        return replace(result, notes=(*result.notes, *note_on_untested(reasons)))

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
    """Returns why each pair can't be tested, "" if it can."""
    ego = fit.middle(fit.flow_of(pairs, pairs.motion)).nan_to_num(0.0)
    # While a camera stands still, neither flow nor depth changes.
    still = fit.EYE.expand(len(pairs.K), 4, 4)
    seen = fit.middle(fit.residuals(pairs, still)).nan_to_num(0.0)
    moves = torch.maximum(seen, ego) >= REST_PX
    has_depth, known = pairs.now.isfinite().flatten(1).any(1), ~pairs.depth.isnan()
    number = known.sum(-1) * pairs.depth.isfinite().any(-1)  # the sky alone has no depth to judge
    return [
        "depth is nowhere known" if not is_known
        else "too few pixels are known" if count < 2 * FEW_PIXELS
        else "" if is_moving else _STILL
        for is_known, count, is_moving in zip(*map(Tensor.tolist, (has_depth, number, moves)))
    ]  # fmt: skip


def tested(reasons: Sequence[str]) -> list[int]:
    """Returns the pairs to test: those that move, and those at rest if few do."""
    moving = [i for i, why in enumerate(reasons) if not why]
    known = [i for i, why in enumerate(reasons) if why in ("", _STILL)]
    return moving if len(moving) >= FEW else known


def note_on_untested(reasons: Sequence[str]) -> list[str]:
    """Returns a note on pairs that tell little, if they are many."""
    few = [why for why in reasons if why]
    if len(few) < MANY * len(reasons):
        return []
    return [f"{len(few)} of {len(reasons)} pairs tell little: {max(few, key=few.count)}"]


def no_diagnosis(reasons: Sequence[str]) -> Diagnosis:
    """Returns the diagnosis if no pair can be tested."""
    why = max(reasons, key=reasons.count) if reasons else "there are no two successive frames"
    return Diagnosis("can't tell", f"{why}; record frames in which the camera moves and turns")
