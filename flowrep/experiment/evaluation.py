"""Outcomes of whole episodes, with intervals."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from statistics import NormalDist

from tensordict import TensorDictBase

from flowrep.envs import Outcome

Policy = Callable[[TensorDictBase], TensorDictBase]

OUTCOMES = tuple(outcome.label for outcome in Outcome)
"""Names of the env's `outcome` codes; each one but the first ends an episode."""


@dataclass(frozen=True)
class Episode:
    """One finished episode: seed, outcome, what was hit, return and length in steps."""

    episode_seed: int
    outcome: str
    hit: str
    total_reward: float
    length: int


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Returns Wilson's score interval of a proportion; (0, 1) without trials.

    >>> low, high = wilson_interval(8, 10)
    >>> round(low, 3), round(high, 3)
    (0.49, 0.943)
    """
    if not trials:
        return 0.0, 1.0
    z2 = NormalDist().inv_cdf(0.5 + confidence / 2) ** 2
    share = successes / trials
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = (z2 * share * (1 - share) / trials + z2**2 / (4 * trials**2)) ** 0.5 / (1 + z2 / trials)
    # the share is within, but rounding may leave an end an ulp inside of it, or outside of [0, 1]
    return max(0.0, min(share, centre - half)), min(1.0, max(share, centre + half))


def outcome_shares(outcomes: Iterable[str]) -> dict[str, tuple[float, float, float]]:
    """Returns the share of each outcome that ends an episode, with its 95 % Wilson interval."""
    counts = Counter(outcomes)
    trials = counts.total()
    return {
        name: (counts[name] / max(trials, 1), *wilson_interval(counts[name], trials))
        for name in OUTCOMES[1:]
    }
