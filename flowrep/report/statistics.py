"""Statistics of the success of a few runs: means with t intervals, Welch's test, Holm's correction.

The unit is the run. All episodes of a run share its weights, so even hundreds of them say little
about what another seed would have learned. A run therefore counts as one number, its success rate.
Rates are arrays `[R]`, one for each scene and each side of a comparison. In a mean over scenes, all
scenes have the same weight; otherwise a side with more seeds in the easier scene would look better.

With few runs, a t interval is wide. A bootstrap over the same runs would be too narrow: with five
runs it covers the mean in 84 % of cases instead of 95 %.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # its parts load at first use: a mistyped folder need not wait for them
from numpy.typing import NDArray

from flowrep.experiment.outcomes import wilson_interval

Array = NDArray[np.float64]

LEVEL = 0.05  # of tests; intervals cover 1 - LEVEL


class Estimate(NamedTuple):
    """A number with the bounds of its 95 % interval, nan if they are unknown."""

    value: float
    low: float
    high: float


class Effect(NamedTuple):
    """A difference in the mean over scenes, its standard error and degrees of freedom."""

    value: float
    error: float  # nan if a scene has only one run on a side
    freedom: float

    @property
    def p_value(self) -> float:
        """Two-sided p of no difference; nan if the runs don't spread, so that p is unknown."""
        if self.error == 0:
            return 1.0 if self.value == 0 else float("nan")
        return float(2 * scipy.stats.t.sf(abs(self.value) / self.error, self.freedom))

    def interval(self) -> Estimate:
        """Returns the difference with its 95 % interval, which excludes 0 exactly if p < 0.05."""
        if self.error == 0:
            return Estimate(self.value, float("nan"), float("nan"))
        half = self.error * float(scipy.stats.t.ppf(1 - LEVEL / 2, self.freedom))
        return Estimate(self.value, self.value - half, self.value + half)

    def verdict(self, p_value: float) -> str:
        """Returns "higher", "lower", "not seen" or "can't be tested", given the corrected p."""
        if np.isnan(p_value):
            return "can't be tested"
        if p_value >= LEVEL:
            return "not seen"
        return "higher" if self.value > 0 else "lower"


def effect(scenes: Sequence[Sequence[Array]]) -> Effect:
    """Returns the mean over scenes of the first side's mean, minus that of a second side, if any.

    Each scene has one or two sides, arrays `[R]` of rates. With S scenes and the variances s² of
    the R runs of each scene and side, the standard error is sqrt(Σ s²/R) / S, and the degrees of
    freedom are (Σ s²/R)² / Σ ((s²/R)² / (R - 1)): Welch's test with Satterthwaite's approximation.
    Variances are not pooled, because the runs of some stacks either succeed or fail and spread far
    more than those of others.
    """
    means = [side[0].mean() - (side[1].mean() if len(side) > 1 else 0.0) for side in scenes]
    # s²/R and R - 1 of each scene and side with more than one run
    parts = [(s.var(ddof=1) / len(s), len(s) - 1) for side in scenes for s in side if len(s) > 1]
    if len(parts) < sum(map(len, scenes)):
        return Effect(float(np.mean(means)), float("nan"), float("nan"))
    variance = sum(part for part, _ in parts)
    freedom = variance**2 / sum(part**2 / df for part, df in parts) if variance else float("nan")
    return Effect(float(np.mean(means)), variance**0.5 / len(scenes), freedom)


def mean_share(scenes: Sequence[Array], episodes: int = 0) -> Estimate:
    """Returns the mean of rates over a scene's runs, averaged over scenes.

    A single run, or runs with equal rates, show no spread between seeds. If `episodes`, the number
    of episodes behind a rate, is given, the interval is then Wilson's over episodes, which says
    nothing about other seeds.
    """
    mean = effect([(rates,) for rates in scenes])
    if episodes and not mean.error > 0:
        successes = round(mean.value * episodes)
        return Estimate(mean.value, *wilson_interval(successes, episodes))
    value, low, high = mean.interval()
    return Estimate(value, max(low, 0.0), min(high, 1.0))


def improvement(scenes: Sequence[Sequence[Array]]) -> float:
    """Returns how often a run of the first side beats one of the second; a tie counts half."""
    # [R, 1] against [1, R], all pairs of runs of a scene
    pairs = [(ours[:, None], theirs[None]) for ours, theirs in scenes]
    return float(np.mean([((a > b) + 0.5 * (a == b)).mean() for a, b in pairs]))


def holm(p_values: Sequence[float]) -> list[float]:
    """Returns p values corrected for their number by Holm's method; nan stays nan.

    The k-th smallest of n (from 0) is multiplied by n - k. A corrected value must not be below the
    previous one; otherwise a larger p could become significant before a smaller one. scipy has no
    function for Holm's method.
    """
    known = sorted((p, i) for i, p in enumerate(p_values) if not np.isnan(p))
    corrected, largest = list(p_values), 0.0
    for k, (p, i) in enumerate(known):
        largest = max(largest, min(1.0, p * (len(known) - k)))
        corrected[i] = largest
    return corrected
