"""The verdict on pairs of frames: the likeliest explanation, and what it hides, by the `limits`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch

from flowrep.diagnosis import limits
from flowrep.diagnosis.competition import Competition
from flowrep.diagnosis.explanation import Explanation
from flowrep.diagnosis.fit import Pairs, length, median, middle, residuals
from flowrep.diagnosis.mistakes import Mistake
from flowrep.diagnosis.pictures import best_of
from flowrep.diagnosis.poses import most_noise_px


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
        corrected_px: median residual after each correction, by correction.
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
    corrected_px: Mapping[str, float] = field(default_factory=dict)
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
            order = {x: (x not in self.suspects, px) for x, px in self.corrected_px.items()}
            named = sorted(order, key=order.__getitem__)[: 5 * self.is_wrong]
            rows |= {name[:52]: self.corrected_px[name] for name in named}
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
        instruction: tells the user what to do, given `Mistake.remedy` and the corrected pairs.
    """
    case = _Case(found)
    return (
        case.of_a_likelier_explanation(instruction)
        or case.of_poses(names)
        or case.of_what_would_not_show()
        or case.right()
    )


class _Case:
    """The pairs of a competition before their judge; what gives no verdict returns None."""

    def __init__(self, found: Competition) -> None:
        self.found, self.recorded, self.pairs = found, found.recorded, found.recorded.pairs
        px, share = limits.HARMLESS
        self.harmless_px = max(px, share * found.flow_px)
        # Flow shows whether it moves; the motion that fits depth best may be a wrong one.
        seen_px = found.flow_px if self.pairs.by_flow else max(found.flow_px, found.ego_px)
        self.is_at_rest = seen_px < limits.REST_PX
        # At rest, there is no flow but that of poses' noise to be wrong.
        self.unsure_px = limits.REST_PX if self.is_at_rest else limits.MATTERS * self.harmless_px
        self.rough_px = max(most_noise_px(self.pairs, found.flow_px), self.harmless_px)
        self.noise_px = found.noise.typical_px
        self.effects_px = {each: each.effect_px(self.recorded) for each in found.others}
        self.left_px = _left_px(self.recorded)
        self.best_px = median(middle(residuals(self.pairs, best_of(self.recorded.shown))))
        self.notes: list[str] = []
        # Flow's errors that are alike in all pictures, so that more pictures don't show them.
        is_biased = self.pairs.is_estimated
        self.bias_px = px + share * found.flow_px if is_biased else 0.0
        self.size = f"flow: {found.flow_px:.2g} px"
        self.unknown = f"and none of {len(found.mistakes)} known mistakes explains it"
        self.error_px = self.poses_px = math.nan
        if self.recorded.poses is not None:
            self.poses_px = max(self.recorded.deviation_px, *self.recorded.poses.noise_px)
            error_px = math.hypot(sum(self.recorded.systematic_px), self.bias_px)
            self.error_px = max([error_px, *self._hidden_px()])

    def _hidden_px(self) -> list[float]:
        """Returns how far explanations that data don't refute change more than their noise."""
        noise = {"poses": self.poses_px, "flow": self.noise_px}
        return [
            px
            for each, px in self.effects_px.items()
            if each.nats > self.recorded.nats - limits.ALIKE
            and self.found.is_seen(each)
            and px > limits.NOISE * noise.get(each.mistake.subject, 0.0)
        ]

    def _diagnosis(self, verdict: Any, words: str, **more: Any) -> Diagnosis:
        width, others = self.pairs.now.shape[-1], self.found.others
        corrected_px = {each.mistake.texts(each.n, width)[0]: _left_px(each) for each in others}
        return Diagnosis(
            verdict, words, len(self.pairs.K), self.found.flow_px, self.left_px, self.best_px,
            self.error_px, self.poses_px, corrected_px, notes=tuple(self.notes), **more,
        )  # fmt: skip

    def _leaves_less(self, left_px: float) -> bool:
        """Whether what is left of depth is clearly less than as recorded; flow's noise is known."""
        return self.pairs.by_flow or left_px < limits.ALIKE_LEFT * self.left_px

    def of_a_likelier_explanation(
        self, instruction: Callable[[str, Pairs], str]
    ) -> Diagnosis | None:
        """Returns the verdict if other explanations than the data as recorded are likelier."""
        least_px = max(self.harmless_px, self.bias_px, 2 * self.noise_px * self.pairs.is_estimated)
        if self.is_at_rest:
            least_px = max(least_px, self.rough_px)
        if self.recorded.poses is not None:  # what pictures don't show is no mistake for certain
            least_px = max(least_px, self.recorded.systematic_px[1])
        vague_px = max(self.unsure_px, least_px) + self.bias_px
        alike = self._likeliest(least_px, vague_px)
        if not alike:
            return None
        texts = [each.mistake.texts(each.n, self.pairs.now.shape[-1]) for each in alike]
        effects = [f"change flow by {self.effects_px[each]:.2g} px" for each in alike]
        if alike[0].mistake.is_vague:
            why = f"{texts[0][1]}, which would {effects[0]} ({self.size})"
            return self._diagnosis("something is wrong", f"{why}, {self.unknown} better")
        ways = (
            f"{said} ({instruction(remedy, each.pairs)} would {effect})"
            for each, (remedy, said), effect in zip(alike, texts, effects)
        )
        suspects = tuple(remedy for remedy, _ in texts)
        return self._diagnosis("wrong", f"{' or '.join(ways)}; {self.size}", suspects=suspects)

    def _likeliest(self, least_px: float, vague_px: float) -> list[Explanation]:
        """Returns explanations that are better than the data as recorded for certain, and alike.

        One that changes little, that leaves about as much, or more than noise and a quarter of how
        far poses are off as recorded, is not what is wrong.

        Args:
            least_px: what a mistake with a name has to change flow by.
            vague_px: the same of one without.
        """
        recorded = self.recorded
        possible = [each for each in self.found.others if self.found.is_proven(each)]
        if recorded.poses is not None:
            most_px = max(self.rough_px, limits.MOST_NOISE * recorded.deviation_px)
            possible = [x for x in possible if x.deviation_px <= most_px]
        sure = {
            each: each.sure_nats(recorded)
            for each in possible
            if self.effects_px[each] > (vague_px if each.mistake.is_vague else least_px)
            and self._leaves_less(_left_px(each))
        }
        most = max(sure.values(), default=0.0)
        ranked = sorted(sure, key=lambda each: (-min(sure[each], most - limits.ALIKE), -each.nats))
        if not ranked or min(sure[ranked[0]], ranked[0].nats - recorded.nats) <= limits.SURE:
            return []
        first = ranked[0]
        if first.mistake.is_vague:
            return [first]
        # Those that pairs don't agree to be worse than the first.
        named = [each for each in ranked if not each.mistake.is_vague and sure[each] > 0]
        alike = [each for each in named if first.sure_nats(each) <= limits.ALIKE]
        alike = sorted(alike, key=lambda each: -each.nats)
        # Of those with one subject, the ones with more numbers than needed say nothing more.
        fewest = {e.mistake.subject: len(e.n) for e in sorted(alike, key=lambda e: -len(e.n))}
        simple = [each for each in alike if len(each.n) <= fewest[each.mistake.subject] + 1]
        return simple[: limits.FEW]

    def of_poses(self, names: Sequence[str]) -> Diagnosis | None:
        """Returns the verdict if recorded motions aren't those of the pictures; adds notes."""
        poses, is_world = self.recorded.poses, self.recorded.shown.shares.amax(0) > 0.5
        if poses is None or is_world.double().mean() <= 0.5:
            return None
        deviation_px, resolution_px = self.recorded.deviation_px, self.recorded.systematic_px[1]
        # A body that is hidden in the noise pulls the world's motion by about as much.
        least_px = max(self.unsure_px, limits.NOISE * self.noise_px)
        is_clear = self._leaves_less(self.best_px)
        has_rule = self.found.rule_nats > limits.SURE and self.found.rule_px > least_px
        if has_rule and is_clear and not self.pairs.is_estimated:
            why = f"errors of poses follow a rule, {self.found.rule_px:.2g} px ({self.size})"
            return self._diagnosis("something is wrong", f"{why}, {self.unknown}")
        if is_clear and deviation_px > max(self.rough_px, least_px, 2 * resolution_px):
            why = f"the recorded motion is {deviation_px:.2g} px from that of the pictures"
            return self._diagnosis("something is wrong", f"{why} ({self.size}), {self.unknown}")
        if not self.pairs.by_flow and self.left_px > max(self.rough_px, least_px):
            # In directions that depth doesn't determine, the nearest motion is as near as it likes.
            rest = length(residuals(self.pairs, self.pairs.motion))
            fits = (rest < limits.NOISE * self.found.noise.px).double()
            share = torch.where(rest.isnan(), math.nan, fits).nanmean(-1)[is_world]
            if (share < limits.BODY).double().mean() > 0.5:
                why = f"hardly a pixel moves as recorded, {self.left_px:.2g} px are left"
                return self._diagnosis("something is wrong", f"{why} ({self.size}), {self.unknown}")
        off_px = poses.y.norm(dim=-1)
        is_bad = poses.is_bad & is_world & (off_px > limits.NOISE * poses.sigma_px)
        is_bad &= off_px > max(limits.NOISE * deviation_px, self.rough_px)
        bad = [name for name, is_one in zip(names, is_bad.tolist()) if is_one]
        many = 0.5 if self.pairs.is_estimated else limits.MANY  # an estimate fails in some pairs
        if len(bad) >= max(limits.FEW, many * len(names)):
            why = f"poses of {len(bad)} in {len(names)} pairs don't fit: {', '.join(bad)}"
            if self.pairs.is_estimated:
                return self._diagnosis("can't tell", f"{why}, or flow was estimated wrongly")
            if self.recorded.is_beside_bodies:
                return self._diagnosis("can't tell", f"{why}, or a body fills the picture")
            return self._diagnosis("something is wrong", why)
        if bad:
            self.notes.append(f"poses that don't fit the others: {', '.join(bad)}")
        if deviation_px > max(2 * resolution_px, self.harmless_px):
            note = "the poses are rough: motion estimated from flow and depth fits better"
            self.notes.append(note)
        return None

    def of_what_would_not_show(self) -> Diagnosis | None:
        """Returns the verdict if the data would look alike with an error that matters."""
        # By the pixels, not the shares: motions that are alternatives share the same pixels.
        explained = self.recorded.shown.odds.amax(0)[~self.pairs.depth.isnan()]
        lost = 1 - float(explained.mean())
        if self.pairs.by_flow and lost > 0.5:
            why = f"{lost:.0%} of pixels follow no motion, neither the camera's nor a body's"
        elif not self.error_px > self.unsure_px:
            return None
        elif self.pairs.is_estimated and self.noise_px > self.unsure_px:
            why = f"flow estimated from the pictures has a noise of {self.noise_px:.2g} px"
            why += f" ({self.size}); a finer flow.preset may do better"
        else:
            why = f"errors of up to {self.error_px:.2g} px would not show ({self.size})"
        return self._diagnosis("can't tell", why)

    def right(self) -> Diagnosis:
        """Returns the verdict if nothing speaks against the data."""
        outliers = 1 - self.recorded.own_share
        if outliers > limits.HARMLESS[1] and self.pairs.by_flow:
            note = f"{outliers:.0%} of pixels don't fit: they move, or depth is wrong there"
            self.notes.append(note)
        noise = f"({self.size}), beside noise of {self.noise_px:.2g} px"
        if self.recorded.poses is None:
            self.notes.append("poses, K and the unit of depth are not tested")
            return self._diagnosis("right", f"one motion explains raw flow and depth {noise}")
        if self.is_at_rest:
            self.notes.append("the camera hardly moves: no convention is tested")
        parts = "raw flow, " * self.pairs.by_flow + "depth, K, the camera's motion"
        words = f"{parts} agree to within {self.error_px:.2g} px {noise}"
        words += f" and poses' {self.poses_px:.2g} px"
        unseen = _unseen(self.pairs, self.found.mistakes, max(self.error_px, self.harmless_px))
        return self._diagnosis("right", words, unseen=unseen)


def _left_px(each: Explanation) -> float:
    return median(middle(residuals(each.pairs, each.motion)))


def _unseen(pairs: Pairs, mistakes: Sequence[Mistake], least: float) -> tuple[str, ...]:
    """Returns the corrections whose usual mistake would not change the residuals here."""
    pairs, unseen = pairs.few, []
    now = residuals(pairs, pairs.motion)
    for mistake in mistakes:
        if len(mistake.usual) == len(mistake.start[0]):
            other = mistake.change(pairs, now.new_tensor(mistake.usual).expand(len(now), -1))
            apart = length(residuals(other, other.motion) - now)
            if median(apart.nanmedian(-1).values) <= least:
                unseen.append(mistake.name)
    return tuple(dict.fromkeys(unseen))
