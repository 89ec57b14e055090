"""Drivers that learn nothing, which any agent is measured beside: a planner and baselines."""

from flowrep.drivers.baselines import BASELINES, Drive, RandomDriver, drives, never_turn
from flowrep.drivers.planner import Planner

__all__ = ["BASELINES", "Drive", "Planner", "RandomDriver", "drives", "never_turn"]
