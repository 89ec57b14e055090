"""Baselines to compare an agent with: privileged planners, never turning, random actions."""

from flowrep.baselines.planner import Planner
from flowrep.baselines.registry import (
    BASELINES,
    Baseline,
    BaselinePolicy,
    RandomActions,
    never_turn,
)

__all__ = ["BASELINES", "Baseline", "BaselinePolicy", "Planner", "RandomActions", "never_turn"]
