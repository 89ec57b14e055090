"""Sorts runs into families that agree in every config key except what is compared."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

from flowrep.report.runs import Run

ABSENT = "absent"
_SHOWN = 3  # keys in a label
_LONG = 24  # characters of a value; a longer one is shown as a version number


@dataclass(frozen=True)
class Family:
    """Runs that may be compared: they differ in scene, representations and seed alone.

    Args:
        runs: the family's runs; one that can't have a key, as `ego` can't have
            `representations.obj.scale`, may be in several families.
        differences: the keys in which families differ, with this one's values as text.
    """

    runs: tuple[Run, ...]
    differences: dict[str, str]

    @property
    def label(self) -> str:
        """What distinguishes it from other families; empty if it is the only one."""
        shown = [f"{key}={value}" for key, value in self.differences.items()]
        rest = [f"{len(shown) - _SHOWN} more keys"] if len(shown) > _SHOWN + 1 else []
        return ", ".join(shown[:_SHOWN] + rest if rest else shown)


def families_of(runs: Sequence[Run]) -> list[Family]:
    """Returns families, the one with the most runs first."""
    keys = dict.fromkeys(key for run in runs for key in run.identity)
    lacking = {key: _lacking(key, runs) for key in keys}
    values: dict[str, dict[Hashable, Any]] = {}
    identities = []
    for run in runs:
        lacks = {key: ABSENT for key in keys if run in lacking[key]}
        identities.append(run.identity | lacks)
        for key, value in identities[-1].items():
            values.setdefault(key, {})[repr(value)] = value
    differing = [key for key in keys if len(values[key]) > 1]
    signatures = [
        {key: repr(identity[key]) for key in differing if key in identity}
        for identity in identities
    ]
    distinct = list({tuple(sorted(s.items())): s for s in signatures}.values())
    whole = _widest(distinct)
    found = []
    for signature in whole:
        members = [run for run, own in zip(runs, signatures) if _fits(own, signature)]
        shown = {
            key: _text(key, values[key], signature[key]) for key in differing if key in signature
        }
        found.append(Family(tuple(members), shown))
    return sorted(found, key=lambda family: -len(family.runs))


def _lacking(key: str, runs: Sequence[Run]) -> set[Run]:
    """Returns the runs without a key that they could have, as others with the same part do."""
    parts = {run.part_with(key) for run in runs if key in run.identity}
    return {run for run in runs if key not in run.identity and run.part_with(key) in parts}


Signature = dict[str, str]


def _widest(signatures: Sequence[Signature]) -> list[Signature]:
    """Returns signatures merged with all that they don't contradict, none contained in another."""
    joined: list[Signature] = []
    for signature in sorted(signatures, key=len, reverse=True):
        for place, other in enumerate(joined):
            if all(other.get(key, value) == value for key, value in signature.items()):
                joined[place] = other | signature
                break
        else:
            joined.append(dict(signature))
    return joined


def _fits(own: Signature, signature: Signature) -> bool:
    return all(signature.get(key, value) == value for key, value in own.items())


def _text(key: str, values: dict[Hashable, Any], chosen: str) -> str:
    text = str(values[chosen])
    if len(text) <= _LONG:
        return text
    return f"{sorted(values, key=str).index(chosen) + 1} of {len(values)} versions"
