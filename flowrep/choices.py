"""Names and bounds that several packages know; it imports nothing that takes time."""

from typing import Literal

SpeedMode = Literal["low", "normal", "high"]
"""How fast pedestrians walk; each scene has the speeds."""
FRAME_RATES_HZ = (0.5, 1_000.0)  # lowest and highest
# PyBullet's software renderer samples pixel (column i, row j), whose centre is (i + 0.5, j + 0.5),
# at (i, j + 1) of a camera with the principal point in the middle, and the rasteriser does the
# same. In K, which unprojects onto the true surfaces, the principal point is therefore shifted;
# `tests/envs/test_camera.py` measures this.
PRINCIPAL_POINT_SHIFT_PX = (0.5, -0.5)
Renderer = Literal["auto", "rasteriser", "pybullet"]
BaselineName = Literal["planner", "speed_blind", "never_turn", "random"]
