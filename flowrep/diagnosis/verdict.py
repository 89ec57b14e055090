"""The verdict on pairs of frames: which explanation of them is the likeliest, and what it hides."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from flowrep.diagnosis.competition import Competition
from flowrep.diagnosis.explanation import SURE, Explanation, most_noise_px
from flowrep.diagnosis.fit import Pairs, length, median, middle, residuals
from flowrep.diagnosis.pictures import best_of
from flowrep.diagnosis.rivals import Rival

# An error that is smaller than one of these does nobody harm; one of three times that is no longer
# "right".
_HARMLESS_PX = 0.05
_HARMLESS = 0.05  # of the flow's length
_REST_PX = 0.25  # flow of a camera at rest: poses' noise is all that a correction may change
_ALIKE = 3.0  # nats: explanations that are as near to the likeliest are told beside it
_ALIKE_SHARE = 0.7  # of a vague one's nats: a mistake with a name explains as much
_NOISE = 3.0  # times the noise: differences below it may be noise
_MANY = 0.2  # of all pairs: if poses of so many don't fit, they are wrong


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
        error_px: the error that all recorded motions may share. If the verdict is "right", the
            conventions are right to this many pixels. nan without poses.
        rough_px: the noise of single recorded motions.
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
    rough_px: float = math.nan
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


def judged(
    found: Competition, names: Sequence[str], instruction: Callable[[str, Pairs], str]
) -> Diagnosis:
    """Returns the verdict on pairs of frames.

    Args:
        names: the names of the frames.
        instruction: tells the user what to do, given `Rival.remedy` and the corrected pairs.
    """
    recorded, rivals, flow_px = found.recorded, found.rivals, found.flow_px
    pairs, width = recorded.pairs, recorded.pairs.now.shape[-1]
    harmless_px = max(_HARMLESS_PX, _HARMLESS * flow_px)
    unsure_px = 3 * harmless_px
    # Flow's errors that are alike in all pictures, so that more pictures don't show them.
    bias_px = _HARMLESS_PX + _HARMLESS * flow_px if pairs.is_estimated else 0.0
    effects = {each: each.effect_px(recorded) for each in found.others}
    numbers: dict[str, Any] = {
        "pairs": len(pairs.K), "raw_px": flow_px,
        "best_px": median(middle(residuals(pairs, best_of(recorded.shown)))),
        **_errors_px(found, effects, bias_px), "left_px": _left_px(recorded),
        "rivals_px": {e.rival.texts(e.n, width)[0]: _left_px(e) for e in found.others},
    }  # fmt: skip
    size, unknown = f"flow: {flow_px:.2g} px", f"and none of {len(rivals)} known mistakes explains"

    def given(verdict: Any, words: str, **more: Any) -> Diagnosis:
        return Diagnosis(verdict, words, **numbers, **more)

    most_px = max(most_noise_px(pairs, flow_px), harmless_px)
    least_px = most_px if flow_px < _REST_PX else max(harmless_px, bias_px)
    if recorded.poses is not None:  # what pictures don't show can't be told from a mistake
        least_px = max(least_px, recorded.systematic_px()[1])
    if alike := _likeliest(found, effects, least_px, unsure_px + bias_px):
        texts = [each.rival.texts(each.n, width) for each in alike]
        if alike[0].rival.is_vague:
            why = f"{texts[0][1]}, which changes flow by {effects[alike[0]]:.2g} px ({size})"
            return given("something is wrong", f"{why}, {unknown} it better")
        ways = (
            f"{said} ({instruction(remedy, each.pairs)} would change flow by "
            f"{effects[each]:.2g} px)"
            for each, (remedy, said) in zip(alike, texts)
        )
        suspects = tuple(remedy for remedy, _ in texts)
        return given("wrong", f"{' or '.join(ways)}; {size}", suspects=suspects)
    notes = []
    is_world = recorded.shown.shares.amax(0) > 0.5
    if recorded.poses is not None and is_world.double().mean() > 0.5:
        resolution_px = recorded.systematic_px()[1]
        # A body that is hidden in the noise pulls the world's motion by about as much.
        least_px = max(unsure_px, _NOISE * found.noise.typical_px)
        if found.rule_nats > SURE and found.rule_px > least_px and not pairs.is_estimated:
            why = f"errors of poses follow a rule, {found.rule_px:.2g} px ({size})"
            return given("something is wrong", f"{why}, {unknown} it")
        off_px, sigma_px = recorded.poses.y.norm(dim=-1), recorded.poses.sigma_px
        if recorded.deviation_px > max(most_px, least_px, 2 * resolution_px):
            why = f"the recorded motion is {recorded.deviation_px:.2g} px from that of the pictures"
            return given("something is wrong", f"{why} ({size}), {unknown} it")
        is_bad = recorded.poses.is_bad & is_world & (off_px > _NOISE * sigma_px)
        is_bad &= off_px > max(_NOISE * recorded.deviation_px, most_px)
        bad = [name for name, is_one in zip(names, is_bad.tolist()) if is_one]
        if len(bad) >= max(3, _MANY * len(names)) and not pairs.is_estimated:
            why = f"poses of {len(bad)} in {len(names)} pairs don't fit: {', '.join(bad)}"
            return given("something is wrong", why)
        if bad:
            notes.append(f"poses that don't fit the others: {', '.join(bad)}")
        if recorded.deviation_px > max(2 * resolution_px, harmless_px):
            notes.append("the poses are rough: motion estimated from flow and depth fits better")
    # By the pixels, not the shares: motions that are alternatives share the same pixels.
    explained = recorded.shown.odds.amax(0)[~pairs.depth.isnan()]
    if pairs.by_flow and (lost := 1 - float(explained.mean())) > 0.5:
        why = f"{lost:.0%} of pixels follow no motion, neither the camera's nor a body's"
        return given("can't tell", why)
    if numbers["error_px"] > unsure_px:
        why = f"errors of up to {numbers['error_px']:.2g} px would not show ({size})"
        if pairs.is_estimated and found.noise.typical_px > unsure_px:
            why = f"flow estimated from the pictures has a noise of {found.noise.typical_px:.2g} px"
            why += f" ({size}); a finer flow.preset may do better"
        return given("can't tell", why)
    outliers = 1 - float(recorded.shown.shares.amax(0).mean())
    if outliers > _HARMLESS and pairs.by_flow:
        notes.append(f"{outliers:.0%} of pixels don't fit: they move, or depth is wrong there")
    noise = f"({size}), beside noise of {found.noise.typical_px:.2g} px"
    if recorded.poses is None:
        notes.append("poses, K and the unit of depth are not tested")
        return given("right", f"one motion explains raw flow and depth {noise}", notes=tuple(notes))
    parts = "raw flow, " * pairs.by_flow + "depth, K, the camera's motion"
    agree = f"{parts} agree to within {numbers['error_px']:.2g} px {noise}"
    agree += f" and poses' {numbers['rough_px']:.2g} px"
    unseen = _unseen(pairs, rivals, max(numbers["error_px"], harmless_px))
    return given("right", agree, unseen=unseen, notes=tuple(notes))


def _errors_px(
    found: Competition, effects: Mapping[Explanation, float], bias_px: float
) -> dict[str, float]:
    """Returns the error that data as recorded may hide, and the noise of their motions, px."""
    recorded = found.recorded
    if recorded.poses is None:
        return {"error_px": math.nan, "rough_px": math.nan}
    rough_px = max(recorded.deviation_px, *recorded.poses.noise_px)
    noise = {"poses": rough_px, "flow": found.noise.typical_px}
    # What the data don't refute may be so, unless it is their noise that changes.
    hidden = [
        effects[each]
        for each in found.others
        if each.nats > recorded.nats - _ALIKE
        and found.is_seen(each)
        and effects[each] > _NOISE * noise.get(each.rival.subject, 0.0)
    ]
    error_px = math.hypot(*recorded.systematic_px(), bias_px)
    return {"error_px": max([error_px, *hidden]), "rough_px": rough_px}


def _likeliest(
    found: Competition, effects: Mapping[Explanation, float], least_px: float, vague_px: float
) -> list[Explanation]:
    """Returns the explanations that are better than the data as recorded for certain, and alike.

    Args:
        least_px: what a mistake with a name has to change flow by.
        vague_px: the same of one without.
    """
    sure = {each: each.sure_nats(found.recorded) for each in found.others}
    most = max(sure.values(), default=0.0)
    ranked = sorted(sure, key=lambda each: (-min(sure[each], most - _ALIKE), -each.nats))
    named = [each for each in ranked if not each.rival.is_vague]
    if named and sure[named[0]] > _ALIKE_SHARE * sure[ranked[0]]:
        ranked = named  # what is left may be a second mistake
    if not ranked:
        return []
    first = ranked[0]
    least_px = vague_px if first.rival.is_vague else least_px
    gain = min(sure[first], first.nats - found.recorded.nats)
    if gain <= SURE or effects[first] <= least_px or not found.is_seen(first):
        return []
    if first.rival.is_vague:
        return [first]
    alike = [
        each
        for each in named
        if each.nats > first.nats - _ALIKE and sure[each] > sure[first] - _ALIKE
    ]
    # Of those with one subject, the ones with more numbers than needed say nothing more.
    fewest = {e.rival.subject: len(e.n) for e in sorted(alike, key=lambda e: -len(e.n))}
    return [each for each in alike if len(each.n) <= fewest[each.rival.subject] + 1]


def _left_px(each: Explanation) -> float:
    return median(middle(residuals(each.pairs, each.motion)))


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
