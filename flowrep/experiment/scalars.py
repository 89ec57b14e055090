"""Evaluated episodes as the numbers that TensorBoard and Weights & Biases plot."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from statistics import fmean
from typing import Any

from flowrep.experiment.evaluation import OUTCOMES

_TITLES = {"training": "evaluation"}  # training itself has scalars too


def evaluation_scalars(rows: Iterable[Mapping[str, Any]]) -> dict[int, dict[str, float]]:
    """Returns shares of outcomes, mean return and mean length of each evaluation, by frames.

    Args:
        rows: rows of evaluation.csv.

    >>> row = {"scene": "s_turn", "evaluation": "final", "policy": "greedy", "speed": "low"}
    >>> row |= {"fps": 12.0, "frames": 100, "outcome": "success", "return": 7.5, "length": 90}
    >>> evaluation_scalars([row])[100]["final/s_turn/low/12fps/greedy/success"]
    1.0
    """
    groups: dict[tuple[int, str], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        kind, rate = row["evaluation"], f"{float(row['fps']):g}fps"
        words = _TITLES.get(kind, kind), row["scene"], row["speed"], rate, row["policy"]
        groups[int(row["frames"]), "/".join(words)].append(row)
    scalars: dict[int, dict[str, float]] = defaultdict(dict)
    for (frames, title), episodes in groups.items():
        outcomes = [episode["outcome"] for episode in episodes]
        for name in OUTCOMES[1:]:
            scalars[frames][f"{title}/{name}"] = outcomes.count(name) / len(outcomes)
        for name in ("return", "length"):
            scalars[frames][f"{title}/{name}"] = fmean(float(e[name]) for e in episodes)
    return dict(scalars)
