"""Statistics of the success of a few runs: means, bootstrap intervals, tests, corrections.

As in rliable (Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical
Precipice, NeurIPS 2021), runs are resampled within their scene. Three things differ. A run's score
is itself a share of a few hundred episodes, so the episodes are resampled too, the same ones for
all runs; otherwise two seeds that happen to agree would have an interval of no width. Scenes may
have different numbers of runs: all count the same in the mean over them, otherwise whoever has more
seeds in the easier scene would seem better. And the score is the mean over runs, not the
interquartile mean: of four runs the latter is the mean of the middle two, which drops the one run
that ended in another way, and p of a test on means would belong to another number.

Outcomes are arrays [R, E]: 1 where run r's episode e has a property such as success, 0 where not,
nan where the run did not drive that episode or it does not count.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from flowrep.experiment.evaluation import wilson_interval

Array = NDArray[np.float64]

LEVEL = 0.05  # of tests; intervals hold the rest
FEWEST_RUNS = 3  # with fewer a side, a difference is one of these agents, not of their stacks
_OF_RUNS, _OF_EPISODES = 0, 1  # keep the two draws independent


class Estimate(NamedTuple):
    """A number with the bounds of its 95 % interval."""

    value: float
    low: float
    high: float


class Comparison(NamedTuple):
    """How much better one side does than another."""

    difference: Estimate  # of the means over runs, in the mean over scenes
    improvement: Estimate  # the probability that a run of the first side beats one of the second
    p_value: float  # of Welch's t-test over the runs' scores; nan where a side has one run alone
    runs: int  # of a side; those of one scene if a scene has one run of a side

    def verdict(self, p_value: float) -> str:
        """Returns how far the difference can be trusted, given its corrected p value."""
        # Both have to agree: a bootstrap over two or three runs has intervals that are too narrow.
        if self.difference.low <= 0 <= self.difference.high or p_value >= LEVEL:
            return "can't be told from noise"
        word = "higher" if self.difference.value > 0 else "lower"
        if self.runs < FEWEST_RUNS:
            seeds = "one seed" if self.runs == 1 else f"{self.runs} seeds"
            return f"{word} for these agents; {seeds} a side say no more"
        return word


def rates(outcomes: Array, weights: Array | None = None) -> Array:
    """Returns each run's share of episodes with a property, such as success, [R].

    With `weights` [N, E], how often each episode counts in each of N resamples: [N, R].
    """
    there, found = ~np.isnan(outcomes), np.nan_to_num(outcomes)
    own = found.sum(axis=1) / np.maximum(there.sum(axis=1), 1)
    if weights is None:
        return own
    counts = weights @ there.T
    # A run without episodes in a resample keeps its own rate there.
    return np.where(counts > 0, weights @ found.T / np.maximum(counts, 1), own)


class Bootstrap(NamedTuple):
    """Resamples runs and episodes so many times; the same outcomes give the same intervals."""

    resamples: int = 2000

    def success(self, scenes: Sequence[Array]) -> Estimate:
        """Returns the mean over a scene's runs, in the mean over scenes; Wilson's of one run."""
        if sum(map(len, scenes)) == 1:
            return _wilson(scenes[0])
        return self.mean(scenes, least=0.0)

    def mean(self, scenes: Sequence[Array], least: float = -1.0) -> Estimate:
        """Returns the same of outcomes from `least` to 1, such as changes between conditions."""
        value = np.mean([rates(outcomes).mean() for outcomes in scenes])
        drawn = [self._rates(k, outcomes)[0] for k, outcomes in enumerate(scenes)]
        means = np.mean([d.mean(axis=-1) for d in drawn], axis=0)
        return _estimate(float(value), means, sum(s.shape[1] for s in scenes), least)

    def pooled_share(self, outcomes: Array) -> Estimate:
        """Returns the share over the pooled episodes of all runs; nan without episodes."""
        if np.isnan(outcomes).all():
            return Estimate(np.nan, np.nan, np.nan)
        if len(outcomes) == 1 or np.nanmin(outcomes) == np.nanmax(outcomes):
            return _wilson(outcomes)
        rng = np.random.default_rng((0, 0, _OF_RUNS))
        weights = _episode_weights(0, outcomes.shape[1], self.resamples)
        chosen = rng.integers(len(outcomes), size=(self.resamples, len(outcomes)))
        there, found = ~np.isnan(outcomes), np.nan_to_num(outcomes)
        counts = np.take_along_axis(weights @ there.T, chosen, axis=1).sum(axis=1)
        sums = np.take_along_axis(weights @ found.T, chosen, axis=1).sum(axis=1)
        drawn = sums[counts > 0] / counts[counts > 0]
        return _estimate(float(found.sum() / there.sum()), drawn, int(there.sum()))

    def compare(self, scenes: Sequence[tuple[Array, Array]]) -> Comparison:
        """Returns how much better the first of each scene's two sides does than the second.

        Column e is the same episode in both, so that its difficulty is no part of the difference.
        """
        own = [(rates(a), rates(b)) for a, b in scenes]
        drawn = [self._rates(k, *pair) for k, pair in enumerate(scenes)]
        difference, differences = (
            np.mean([a.mean(axis=-1) - b.mean(axis=-1) for a, b in pairs], axis=0)
            for pairs in (own, drawn)
        )
        fewest = min(len(side) for pair in own for side in pair)  # of a side in a scene
        runs = fewest if fewest < 2 else min(sum(map(len, side)) for side in zip(*own))
        improvement = float(np.mean([_improvement(*pair) for pair in own]))
        improvements = np.mean([_improvement(*pair) for pair in drawn], axis=0)
        episodes = sum(ours.shape[1] for ours, _ in scenes)  # shared by the runs
        return Comparison(
            _estimate(float(difference), differences, episodes, least=-1.0),
            _estimate(improvement, improvements, episodes),
            effect(own).p_value,
            runs,
        )

    def _rates(self, scene: int, *sides: Array) -> list[Array]:
        # [N, R] of resampled runs of each side, over the same drawn episodes.
        rng = np.random.default_rng((0, scene, _OF_RUNS))
        weights = _episode_weights(scene, sides[0].shape[1], self.resamples)
        drawn = []
        for side in sides:
            chosen = rng.integers(len(side), size=(self.resamples, len(side)))
            drawn.append(np.take_along_axis(rates(side, weights), chosen, axis=1))
        return drawn


def _wilson(outcomes: Array) -> Estimate:
    there = ~np.isnan(outcomes)
    found, trials = int(outcomes[there].sum()), int(there.sum())
    return Estimate(found / max(trials, 1), *wilson_interval(found, trials, 1 - LEVEL))


def _estimate(value: float, drawn: Array, episodes: int, least: float = 0.0) -> Estimate:
    low, high = np.quantile(drawn, [LEVEL / 2, 1 - LEVEL / 2])
    if np.ptp(drawn) < 1e-9:
        # Resamples that all agree say nothing of what other episodes would have shown: the
        # interval is then as wide as Wilson's of a share that is 0 in so many episodes.
        unseen = wilson_interval(0, episodes, 1 - LEVEL)[1]
        low, high = max(value - unseen, least), min(value + unseen, 1.0)
    return Estimate(value, float(low), float(high))


@lru_cache(maxsize=8)
def _episode_weights(scene: int, episodes: int, resamples: int) -> Array:
    # How often each episode is in each resample, [N, E].
    rng = np.random.default_rng((0, scene, _OF_EPISODES))
    shares = np.full(episodes, 1 / episodes)
    return rng.multinomial(episodes, shares, size=resamples).astype(np.float64)


def _improvement(ours: Array, theirs: Array) -> Any:
    # The share of pairs [..., R1] × [..., R2] in which ours is higher; a tie is half.
    a, b = ours[..., :, None], theirs[..., None, :]
    return ((a > b) + 0.5 * (a == b)).mean(axis=(-2, -1))


class Effect(NamedTuple):
    """A difference in the mean over scenes, its standard error and degrees of freedom."""

    value: float
    error: float  # nan where a scene has one run of a side alone
    freedom: float

    @property
    def p_value(self) -> float:
        """Two-sided p of no difference."""
        if self.error == 0:
            return 1.0 if self.value == 0 else 0.0
        return float(2 * stats.t.sf(abs(self.value) / self.error, self.freedom))

    def interval(self) -> Estimate:
        """Returns the difference with its 95 % interval, which leaves out 0 exactly if p < 0.05."""
        if self.error == 0:
            return Estimate(self.value, self.value, self.value)
        half = self.error * float(stats.t.ppf(1 - LEVEL / 2, self.freedom))
        return Estimate(self.value, self.value - half, self.value + half)


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


def holm(p_values: Sequence[float]) -> list[float]:
    """Returns p values corrected for their number by Holm's method, nan left as it is."""
    known = sorted((p, i) for i, p in enumerate(p_values) if not np.isnan(p))
    corrected, worst = list(p_values), 0.0
    for place, (p, i) in enumerate(known):
        worst = max(worst, min(1.0, p * (len(known) - place)))
        corrected[i] = worst
    return corrected
