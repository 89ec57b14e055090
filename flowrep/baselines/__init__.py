"""Baselines to compare an agent with: a privileged planner, never turning, random actions."""

from flowrep.baselines.baselines import BASELINES, Drive, RandomActions, drives, never_turn
from flowrep.baselines.planner import Planner

__all__ = ["BASELINES", "Drive", "Planner", "RandomActions", "drives", "never_turn"]
