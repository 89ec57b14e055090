"""Baselines to compare an agent with: a privileged planner, never turning, random actions."""

from flowrep.baselines.baselines import (
    BASELINES,
    Baseline,
    BaselinePolicy,
    RandomActions,
    never_turn,
)
from flowrep.baselines.planner import Planner

__all__ = ["BASELINES", "Baseline", "BaselinePolicy", "Planner", "RandomActions", "never_turn"]
