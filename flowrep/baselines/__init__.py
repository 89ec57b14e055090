"""Baselines to compare an agent with: a privileged planner, never turning, random actions."""

from flowrep.baselines.planner import Planner
from flowrep.baselines.registry import BASELINES, Drive, RandomActions, drives, never_turn

__all__ = ["BASELINES", "Drive", "Planner", "RandomActions", "drives", "never_turn"]
