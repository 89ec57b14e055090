"""Names and bounds that several packages know; it imports nothing that takes time."""

from typing import Literal

SpeedMode = Literal["low", "normal", "high"]
"""How fast pedestrians walk; each scene has the speeds."""
FRAME_RATES_HZ = (0.5, 1_000.0)  # lowest and highest
Renderer = Literal["auto", "rasteriser", "pybullet"]
BaselineName = Literal["planner", "speed_blind", "never_turn", "random"]
