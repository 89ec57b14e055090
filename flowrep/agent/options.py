"""The options of an algorithm that a config may set, read from its classes' signatures."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from typing import Any

GIVEN_BY_THE_RUN = ("observation_spec", "action_spec", "keys", "total_frames", "device")
GIVEN_BY_THE_CLASS = ("self", "rate_factors", "policy_options", "network", "actor", "actions")


def options_of(makers: Iterable[Any]) -> dict[str, inspect.Parameter]:
    """Returns the classes' parameters by name, up to the first class without `**kwargs`.

    >>> from flowrep.agent import DoubleDQN
    >>> DoubleDQN.options()["final_epsilon"].default, DoubleDQN.options()["tau"].default
    (0.05, 0.005)
    """
    found: dict[str, inspect.Parameter] = {}
    for maker in filter(None, makers):
        parameters = dict(inspect.signature(maker.__init__).parameters)
        rest = [n for n, p in parameters.items() if p.kind is inspect.Parameter.VAR_KEYWORD]
        given = (*GIVEN_BY_THE_RUN, *GIVEN_BY_THE_CLASS, *rest)
        found = {n: p for n, p in parameters.items() if n not in given} | found
        if not rest:
            break
    return found
