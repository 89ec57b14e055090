"""Collisions by PyBullet."""

import math
import os
import weakref
from collections.abc import Sequence
from typing import Any

# PyBullet prints its build time when it is imported, from C, past sys.stderr.
_stderr = os.dup(2)
try:
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    import pybullet
finally:
    os.dup2(_stderr, 2)
    os.close(_stderr)


class Simulator:
    """A world of solids that stay where they are placed; no dynamics are simulated."""

    def __init__(self) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        weakref.finalize(self, pybullet.disconnect, self._client)

    def add_boxes(self, boxes_m: Sequence[tuple[float, ...]]) -> int:
        """Returns the number of a body of up to 16 boxes (x, y, yaw, length, width, height)."""
        solid = pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(boxes_m),
            halfExtents=[[side / 2 for side in box[3:]] for box in boxes_m],
            collisionFramePositions=[[x, y, height / 2] for x, y, *_, height in boxes_m],
            collisionFrameOrientations=[_about_z(box[2]) for box in boxes_m],
            physicsClientId=self._client,
        )
        return pybullet.createMultiBody(0.0, solid, physicsClientId=self._client)

    def add_box(self, length_m: float, width_m: float, height_m: float) -> int:
        """Returns the number of a movable box on the ground."""
        half = [length_m / 2, width_m / 2, height_m / 2]
        return self._add_movable(pybullet.GEOM_BOX, height_m, halfExtents=half)

    def add_cylinder(self, radius_m: float, height_m: float) -> int:
        """Returns the number of a movable upright cylinder."""
        return self._add_movable(pybullet.GEOM_CYLINDER, height_m, radius=radius_m, height=height_m)

    def _add_movable(self, kind: int, height_m: float, **shape: Any) -> int:
        client, above = {"physicsClientId": self._client}, [0.0, 0.0, height_m / 2]
        solid = pybullet.createCollisionShape(kind, collisionFramePosition=above, **shape, **client)
        return pybullet.createMultiBody(1.0, solid, **client)

    def place(self, body: int, x_m: float, y_m: float, yaw_rad: float, z_m: float = 0.0) -> None:
        """Places a body at a planar pose."""
        place = (x_m, y_m, z_m), _about_z(yaw_rad)
        pybullet.resetBasePositionAndOrientation(body, *place, self._client)

    def touch(self, body: int, other: int) -> bool:
        """Returns whether two bodies overlap at their current poses."""
        return bool(pybullet.getClosestPoints(body, other, 0.0, physicsClientId=self._client))


def _about_z(yaw_rad: float) -> tuple[float, float, float, float]:
    return 0.0, 0.0, math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad)
