"""The claims that claims.yaml declares, tested on stored runs.

`verdict_on` decides whether a claim holds, by `flowrep.report.statistics`. A run counts with its
success rate over the episodes that all compared runs drove.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from fnmatch import fnmatch
from itertools import chain, count
from typing import Any, NamedTuple

import numpy as np

from flowrep.report.figures import words
from flowrep.report.runs import (
    SCENES,
    SPEEDS,
    Condition,
    Run,
    departures,
    paired_scores,
    success_rate,
)
from flowrep.report.statistics import LEVEL, Array, Effect, effect, holm, improvement

SHORT = dict(zip(SCENES, ("SR", "ST", "H", "T")))
UNSEEN = "not seen with this recipe"
_CLAIMED = {"more": "higher", "less": "lower"}
_DRAWS = 20_000  # of permutations: the standard error of p = 0.05 is then 0.0015
_COLLAPSED = 0.2  # success at its training speeds below which a run counts as collapsed
_ROUNDS = 3  # complete ones, before contrasts at the paper's length are computed

Studies = Mapping[str, Mapping[str, Sequence[Run]]]


def studies_of(declared: Mapping[str, Any], runs: Sequence[Run]) -> Studies:
    """Returns the runs, trained to the end, of each study and scene, if there are any."""

    def finished(patterns: str) -> list[Run]:
        asked = [r for r in runs if any(fnmatch(r.name, p) for p in patterns.split())]
        return [run for run in asked if run.is_trained]

    return {
        study: {s: of for s, patterns in of_scenes.items() if (of := finished(patterns))}
        for study, of_scenes in declared["studies"].items()
    }


def undated(declared: Mapping[str, Any], studies: Studies) -> list[str]:
    """Returns the studies whose runs don't say when they started, as older ones.

    Raises:
        ValueError: a run started before the rules of its study were committed.
    """
    missing = []
    for study, of_scenes in studies.items():
        runs = [*chain(*of_scenes.values())]
        if any("started" not in run.machine for run in runs):
            missing.append(study)
        since = declared.get("committed", {}).get(study)
        for run in runs:
            started = run.machine.get("started")
            if since and started and datetime.fromisoformat(started) < since:
                raise ValueError(
                    f"{study}: {run.name} started at {started}, before its rules were committed at "
                    f"{since}: run it again, or correct `committed` in claims.yaml"
                )
    return missing


@dataclass
class Contrast:
    """One comparison that claims.yaml asks for, and its outcome.

    p values are corrected if the claim is primary.
    """

    asked: Mapping[str, Any]
    effect: Effect | None  # in the mean over scenes; None if a side has no run
    by_scene: Mapping[str, Effect]
    p_value: float  # of the protocol's test
    p_against: float  # of what contradicts: for `equal`, a difference beyond the margin
    higher: float = float("nan")  # how often a run of the first side beats one of the second

    @property
    def verdict(self) -> str:
        """Returns "holds", "contradicted", `UNSEEN` or "can't be tested"."""
        if self.effect is None:
            return "can't be tested"
        return verdict_on(self.asked["expect"], self.effect, self.p_value, self.p_against)


def verdict_on(expect: str, found: Effect, p_value: float, p_against: float) -> str:
    """Returns whether a claim "holds", is "contradicted", `UNSEEN` or "can't be tested".

    Args:
        expect: the claim about the difference: "more" or "less" than 0, or "equal".
        found: the difference.
        p_value: corrected p of the claim's test; for "equal", of `p_within` the margin.
        p_against: corrected p of `p_beyond` the margin, which contradicts "equal".
    """
    if np.isnan(p_value):
        return "can't be tested"
    if p_value >= LEVEL:
        return "contradicted" if expect == "equal" and p_against < LEVEL else UNSEEN
    holds = expect == "equal" or found.verdict(p_value) == _CLAIMED[expect]
    return "holds" if holds else "contradicted"


def p_within(found: Effect, margin: float) -> float:
    """Returns p of two one-sided tests that a difference is smaller than a margin."""
    # The result is the larger p of the two tests: the one against the nearer end of the margin.
    nearer = found._replace(value=abs(found.value) - margin)
    return nearer.p_value / 2 if nearer.value < 0 else 1 - nearer.p_value / 2


def p_beyond(found: Effect, margin: float) -> float:
    """Returns the two-sided p of a difference that is larger than a margin."""
    nearer = found._replace(value=abs(found.value) - margin)
    return 1.0 if nearer.value < 0 else nearer.p_value


def permuted_p(scenes: Sequence[Sequence[Array]]) -> float:
    """Returns the two-sided p of no difference, by permuting runs between the sides of each scene.

    It makes no assumption about the distribution of rates, so it is valid with outliers, too.
    """
    rng = np.random.default_rng(0)
    totals = np.zeros(_DRAWS)
    for first, second in scenes:
        dealt = rng.permuted(np.tile(np.concatenate([first, second]), (_DRAWS, 1)), axis=1)
        totals += dealt[:, : len(first)].mean(axis=1) - dealt[:, len(first) :].mean(axis=1)
    seen = abs(effect(scenes).value)
    # The observed assignment is one of the possible permutations, hence 1 + ... in both counts.
    return float((1 + (abs(totals / len(scenes)) >= seen - 1e-9).sum()) / (1 + _DRAWS))


class Claim(NamedTuple):
    """A claim of the paper with its contrasts."""

    number: int
    text: str
    limits: str
    contrasts: Sequence[Contrast]

    @property
    def verdict(self) -> str:
        """Returns the verdict on all of its contrasts."""
        verdicts = {contrast.verdict for contrast in self.contrasts}
        if len(verdicts) == 1:
            return verdicts.pop()
        if "holds" in verdicts:
            return "holds in part"
        return "contradicted" if "contradicted" in verdicts else UNSEEN


def claims_of(
    declared: Mapping[str, Any], studies: Studies, study: str = "main"
) -> tuple[list[Claim], list[Claim]]:
    """Returns the primary and secondary claims with their contrasts, of one protocol's runs."""
    numbers = count(1)

    def claim(entry: Mapping[str, Any]) -> Claim:
        contrasts = [
            contrast_of(asked, studies[asked.get("study", study)], declared["scenes"])
            for asked in entry["contrasts"]
        ]
        return Claim(next(numbers), entry["claim"], entry["limits"], contrasts)

    primary, secondary = (list(map(claim, declared[of])) for of in ("primary", "secondary"))
    _correct([contrast for claim in primary for contrast in claim.contrasts])
    return primary, secondary


def at_length(declared: Mapping[str, Any], studies: Studies) -> dict[int, Contrast]:
    """Returns contrasts of the paper's number of frames, paired by seed, by the row of the claim.

    Each family has a correction of its own. The protocol asks for three complete rounds.
    """
    asked, found = declared.get("at_length", {"families": []}), {}
    entries = [*declared["primary"], *declared["secondary"]]
    for family in asked["families"]:
        contrasts = [
            contrast_of(
                entries[row - 1]["contrasts"][0] | {"paired": True, "scenes": asked["scenes"]},
                studies[asked["study"]],
                asked["scenes"],
            )
            for row in family
        ]
        _correct(contrasts)
        found |= dict(zip(family, contrasts))
    return {
        row: contrast
        for row, contrast in found.items()
        if contrast.effect and contrast.effect.freedom >= _ROUNDS - 1
    }


def _correct(contrasts: Sequence[Contrast]) -> None:
    corrected = (holm([getattr(c, name) for c in contrasts]) for name in ("p_value", "p_against"))
    for contrast, p_value, p_against in zip(contrasts, *corrected):
        contrast.p_value, contrast.p_against = p_value, p_against


def contrast_of(
    asked: Mapping[str, Any], study: Mapping[str, Sequence[Run]], scenes: Sequence[str]
) -> Contrast:
    """Returns a contrast in the mean over scenes, with the runs of a study."""
    firsts = [asked["first"]] if isinstance(asked["first"], str) else asked["first"]
    strata: dict[str, list[list[Array]]] = {}  # rates of both sides, by scene and first stack
    for scene, here in study.items():
        for first in firsts:
            sides = scores(_sides(asked | {"first": first}, here), asked)
            if sides is not None and not np.isnan(np.concatenate(sides)).any():
                strata.setdefault(scene, []).append(sides)
    strata = {scene: sides for scene, sides in strata.items() if len(sides) == len(firsts)}
    return _over(asked, strata, asked.get("scenes", scenes))


def _sides(asked: Mapping[str, Any], runs: Sequence[Run]) -> list[list[Run]]:
    stacks = [asked[side] for side in ("first", "second") if side in asked]
    sides = [[run for run in runs if run.stack == stack] for stack in stacks]
    if asked.get("paired"):
        seeds = set.intersection(*({run.seed for run in side} for side in sides))
        return [
            sorted((r for r in side if r.seed in seeds), key=lambda r: r.seed) for side in sides
        ]
    return sides


def _over(
    asked: Mapping[str, Any], strata: Mapping[str, list[list[Array]]], chosen: Sequence[str]
) -> Contrast:
    by_scene = {scene: effect(sides) for scene, sides in strata.items()}
    if not {*chosen} <= {*strata}:
        return Contrast(asked, None, by_scene, float("nan"), float("nan"))
    pairs = [sides for scene in chosen for sides in strata[scene]]
    together = _of_seeds(pairs) if asked.get("paired") else effect(pairs)
    if asked["expect"] == "equal":
        p_values = p_within(together, asked["margin"]), p_beyond(together, asked["margin"])
    else:
        p_values = together.p_value, together.p_value
    higher = improvement(pairs) if "second" in asked else float("nan")
    return Contrast(asked, together, by_scene, *p_values, higher)


def _of_seeds(strata: Sequence[Sequence[Array]]) -> Effect:
    """Returns the effect of differences between runs of one seed, in the mean over strata."""
    differences = [np.subtract(*sides) if len(sides) == 2 else sides[0] for sides in strata]
    return effect([[np.mean(differences, axis=0)]])


class Cell(NamedTuple):
    """A split of the speeds in one scene, for the study of held-out speeds."""

    split: str  # "A"
    name: str  # "A SR"
    title: str
    mode: str  # the speed mode that training left out
    runs: Sequence[Run]


class HeldOut(NamedTuple):
    """A claim on held-out speeds."""

    claim: Claim
    permuted: float  # p
    collapsed: tuple[int, int]  # runs of each side
    without: Contrast  # those runs


def held_out_cells(declared: Mapping[str, Any], studies: Studies) -> list[Cell]:
    """Returns the runs of each split and scene."""
    splits = declared["held_out"]["splits"]
    return [
        Cell(
            split["name"],
            f"{split['name']} {SHORT[scene]}",
            f"{split['name']}, {words(scene)}",
            split["mode"],
            runs,
        )
        for study, split in splits.items()
        for scene, runs in studies[study].items()
    ]


def held_out_claims(declared: Mapping[str, Any], cells: Sequence[Cell]) -> list[HeldOut]:
    """Returns the claims on held-out speeds, in the mean over cells, corrected together."""
    standing = [cell._replace(runs=[r for r in cell.runs if not is_collapsed(r)]) for cell in cells]
    names, found = [cell.name for cell in cells], []
    for number, asked in enumerate(_asked(declared), start=1):
        every, without = (
            _rates(asked, of, lambda cell: {cell.mode: 1}) for of in (cells, standing)
        )
        contrast = _over(asked, every, names)
        p = permuted_p([pair for pairs in every.values() for pair in pairs])
        sides = zip(*(_sides(asked, cell.runs) for cell in cells))
        first, second = (sum(map(is_collapsed, chain(*of_cells))) for of_cells in sides)
        claim = Claim(number, asked["claim"], "", [contrast])
        found.append(HeldOut(claim, p, (first, second), _over(asked, without, names)))
    _correct([each.claim.contrasts[0] for each in found])
    return found


def sensitivity(asked: Mapping[str, Any], cells: Sequence[Cell]) -> dict[str, Contrast]:
    """Returns a claim on held-out speeds in other ways: what it decides hangs on which of them.

    Without the seed, and without the split and scene, whose absence raises p most; and paired by
    seed. Their p values are not corrected.
    """

    def over(of: Sequence[Cell], asked: Mapping[str, Any] = asked) -> Contrast:
        rates = _rates(asked, of, lambda cell: {cell.mode: 1})
        return _over(asked, rates, [cell.name for cell in of])

    def dropped(
        drop: Callable[[Any], Sequence[Cell]], names: Iterable[Any]
    ) -> tuple[str, Contrast]:
        found = {str(name): over(drop(name)) for name in names}
        return max(found.items(), key=lambda item: np.nan_to_num(item[1].p_value, nan=-1))

    seeds = sorted({run.seed for cell in cells for run in cell.runs})
    seed, no_seed = dropped(
        lambda name: [c._replace(runs=[r for r in c.runs if r.seed != name]) for c in cells], seeds
    )
    cell, no_cell = dropped(
        lambda name: [c for c in cells if c.name != name], [c.name for c in cells]
    )
    paired = over(cells, asked | {"paired": True})
    each = np.array([found.value for found in over(cells).by_scene.values()])
    sampled = effect([[each]])
    return {
        seed: no_seed,
        cell: no_cell,
        "paired by seed": paired,
        "panels as a sample": replace(paired, effect=sampled, p_value=sampled.p_value),
    }


def beside_held_out(
    declared: Mapping[str, Any], cells: Sequence[Cell]
) -> list[dict[str, Contrast]]:
    """Returns the secondary contrasts of each claim on held-out speeds, by name."""

    def held_out(cell: Cell) -> dict[str, int]:
        return {cell.mode: 1}

    def trained(cell: Cell) -> dict[str, int]:
        return {cell.runs[0].speed: 1}

    def lost(cell: Cell) -> dict[str, int]:
        return {**trained(cell), cell.mode: -1}

    def other(cell: Cell) -> dict[str, int]:
        return dict.fromkeys({*SPEEDS} - {*lost(cell)}, 1)

    splits = dict.fromkeys(cell.split for cell in cells)
    measured: dict[str, tuple[Sequence[Cell], Callable[[Cell], dict[str, int]]]] = {
        f"held out, {split}": ([cell for cell in cells if cell.split == split], held_out)
        for split in splits
    }
    measured |= {
        "as in training": (cells, trained),
        "extra loss from training to held out": (cells, lost),
        "the paper's training, 1.2–1.8": (cells, other),
    }
    return [
        {
            name: _over(asked, _rates(asked, of, weights), [cell.name for cell in of])
            for name, (of, weights) in measured.items()
        }
        for asked in _asked(declared)
    ]


def _asked(declared: Mapping[str, Any]) -> list[dict[str, Any]]:
    claims = declared["held_out"]["claims"]
    return [entry | {"expect": "more", "success": {"held out": 1}} for entry in claims]


def _rates(
    asked: Mapping[str, Any], cells: Sequence[Cell], weights: Callable[[Cell], Mapping[str, int]]
) -> dict[str, list[list[Array]]]:
    """Returns the success of each run of both sides, by cell, in the cells that have both."""
    found = {
        cell.name: scores(_sides(asked, cell.runs), {"success": weights(cell)}) for cell in cells
    }
    return {name: [rates] for name, rates in found.items() if rates}


def is_collapsed(run: Run) -> bool:
    """Returns whether a run hardly drives, even with people at its training speeds."""
    driven = run.under(Condition("greedy", run.speed, run.fps))["outcome"]
    return not len(driven) or success_rate([driven]) < _COLLAPSED


def scores(sides: Sequence[Sequence[Run]], asked: Mapping[str, Any]) -> list[Array] | None:
    """Returns the score of each run of each side, in one scene; None if a side has no run.

    `asked` names the measure and its conditions as in claims.yaml. Scores are of the episodes that
    all runs of all sides drove.
    """
    if not all(sides):
        return None
    kind = measure_of(asked)
    conditions = conditions_of(sides[0][0], asked[kind])

    def score(outcomes: Sequence[Any]) -> float:
        if kind == "out_of_bounds":
            return departures(outcomes)
        rates = [success_rate([ends]) for ends in outcomes]
        if kind == "kept":
            return rates[0] / rates[1]
        return float(np.dot(rates, [*asked[kind].values()]))

    paired = paired_scores(sides, conditions, score)
    return paired and paired[0]


def measure_of(asked: Mapping[str, Any]) -> str:
    """Returns the name of what a contrast compares."""
    return next(name for name in ("success", "out_of_bounds", "kept") if name in asked)


def conditions_of(run: Run, names: Iterable[str | int]) -> list[Condition]:
    """Returns greedy driving at each speed mode, or at each frame rate and the training speed."""
    asked = [(n, run.fps) if isinstance(n, str) else (run.speed, float(n)) for n in names]
    return [Condition("greedy", *condition) for condition in asked]
