"""Factorized optical flow (ego + object) as mid-level representations for visual RL."""

__version__ = "0.2.0"
