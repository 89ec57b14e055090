"""Statistics of the success of a few runs: means with t intervals, Welch's test, Holm's correction.

The unit is the run. Episodes of one run share its weights, so hundreds of them say little of what
another seed would have learnt: a run counts with one number, its success rate. Rates are arrays
[R], one for each side of a comparison and scene. All scenes count the same in the mean over them;
otherwise whoever has more seeds in the easier scene would seem better.

Of few runs a t interval is wide, where a bootstrap over the same runs is too narrow (of five, it
holds the mean in 84 % of cases instead of 95).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

LEVEL = 0.05  # of tests; intervals hold the rest


class Estimate(NamedTuple):
    """A number with the bounds of its 95 % interval, nan where they aren't known."""

    value: float
    low: float
    high: float


class Effect(NamedTuple):
    """A difference in the mean over scenes, its standard error and degrees of freedom."""

    value: float
    error: float  # nan where a scene has one run of a side alone
    freedom: float

    @property
    def p_value(self) -> float:
        """Two-sided p of no difference; nan where runs show no spread to compare it with."""
        if self.error == 0:
            return 1.0 if self.value == 0 else float("nan")
        return float(2 * stats.t.sf(abs(self.value) / self.error, self.freedom))

    def interval(self) -> Estimate:
        """Returns the difference with its 95 % interval, which leaves out 0 exactly if p < 0.05."""
        if self.error == 0:
            return Estimate(self.value, float("nan"), float("nan"))
        half = self.error * float(stats.t.ppf(1 - LEVEL / 2, self.freedom))
        return Estimate(self.value, self.value - half, self.value + half)

    def verdict(self, p_value: float) -> str:
        """Returns "higher", "lower", "not seen" or "can't be tested", given its corrected p."""
        if np.isnan(p_value):
            return "can't be tested"
        if p_value >= LEVEL:
            return "not seen"
        return "higher" if self.value > 0 else "lower"


def effect(scenes: Sequence[Sequence[Array]]) -> Effect:
    """Returns the mean over scenes of the first side's mean minus the second's, if there is one."""
    means = [side[0].mean() - (side[1].mean() if len(side) > 1 else 0.0) for side in scenes]
    parts = [(s.var(ddof=1) / len(s), len(s) - 1) for side in scenes for s in side if len(s) > 1]
    if len(parts) < sum(map(len, scenes)):
        return Effect(float(np.mean(means)), float("nan"), float("nan"))
    # Variances are not pooled, since some stacks end in one of two ways: Welch and Satterthwaite's
    # degrees of freedom of a sum of means.
    variance = sum(part for part, _ in parts)
    freedom = variance**2 / sum(part**2 / df for part, df in parts) if variance else float("nan")
    return Effect(float(np.mean(means)), variance**0.5 / len(scenes), freedom)


def mean_share(scenes: Sequence[Array], episodes: int = 0) -> Estimate:
    """Returns the mean of rates over a scene's runs, in the mean over scenes.

    One run, or runs that all end alike, show no spread between seeds: given how many `episodes`
    a share is of, they have Wilson's interval, which says nothing of other seeds.
    """
    found = effect([(rates,) for rates in scenes])
    if episodes and not found.error > 0:
        test = stats.binomtest(round(found.value * episodes), episodes)
        return Estimate(found.value, *test.proportion_ci(1 - LEVEL, method="wilson"))
    value, low, high = found.interval()
    return Estimate(value, max(low, 0.0), min(high, 1.0))


def improvement(scenes: Sequence[tuple[Array, Array]]) -> float:
    """Returns how often a run of the first side beats one of the second; a tie is half."""
    pairs = [(ours[:, None], theirs[None]) for ours, theirs in scenes]
    return float(np.mean([((a > b) + 0.5 * (a == b)).mean() for a, b in pairs]))


def holm(p_values: Sequence[float]) -> list[float]:
    """Returns p values corrected for their number by Holm's method, nan left as it is."""
    known = sorted((p, i) for i, p in enumerate(p_values) if not np.isnan(p))
    corrected, worst = list(p_values), 0.0
    for place, (p, i) in enumerate(known):
        worst = max(worst, min(1.0, p * (len(known) - place)))
        corrected[i] = worst
    return corrected
