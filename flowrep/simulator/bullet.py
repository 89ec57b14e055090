"""Bodies, collisions and pictures of a street by PyBullet."""

import functools
import math
import os
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.simulator.meshes import Mesh
from flowrep.simulator.paint import AMBIENT, DIFFUSE, LIGHT

# PyBullet prints its build time when it is imported, from C, past sys.stderr.
_stderr = os.dup(2)
try:
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    import pybullet
finally:
    os.dup2(_stderr, 2)
    os.close(_stderr)

_LIGHT = {
    "lightDirection": list(LIGHT),
    "lightColor": [1.0, 1.0, 1.0],
    "lightAmbientCoeff": AMBIENT,
    "lightDiffuseCoeff": DIFFUSE,
    "lightSpecularCoeff": 0.0,
    "shadow": 0,
    "renderer": pybullet.ER_TINY_RENDERER,
}
_INTERNED: Any = functools.cache(lambda value: value)  # the first object equal to a value


class Picture(NamedTuple):
    """The camera's images."""

    rgba: NDArray[np.uint8]  # [H, W, 4]
    zbuffer: NDArray[np.float32]  # [H, W], as are the numbers of bodies, -1 for none
    body: NDArray[np.int32]


class Simulator:
    """A world of bodies that stay where they are placed; no dynamics are simulated."""

    def __init__(self, texture_rgb: NDArray[np.uint8]) -> None:  # [S, S, 3], of all meshes
        self._client = pybullet.connect(pybullet.DIRECT)
        weakref.finalize(self, pybullet.disconnect, self._client)
        # PyBullet reads textures only from files, with v counted upwards from the bottom row. A TGA
        # file is an 18-byte header and the pixels as BGR.
        height, width, _ = texture_rgb.shape
        size = width.to_bytes(2, "little") + height.to_bytes(2, "little")
        header = bytes([0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0]) + size + bytes([24, 0x20])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "texture.tga")
            path.write_bytes(header + texture_rgb[::-1, :, ::-1].tobytes())
            self._texture = pybullet.loadTexture(str(path), physicsClientId=self._client)

    def add_body(self, mesh: Mesh, boxes_m: Sequence[tuple[float, ...]] = ()) -> int:
        """Returns PyBullet's number of a body; boxes are (x, y, yaw, length, width, height)."""
        # PyBullet leaks the lists that it gets, with their items. So the lists are emptied
        # afterwards, and the items are interned: all clients of the process share the same objects.
        arrays = {
            name: [_INTERNED(tuple(row)) for row in getattr(mesh, name)]
            for name in ("vertices", "normals", "uvs")
        } | {"indices": [_INTERNED(index) for index in mesh.indices]}
        white = [1.0, 1.0, 1.0, 1.0]
        visual = pybullet.createVisualShape(
            pybullet.GEOM_MESH, rgbaColor=white, physicsClientId=self._client, **arrays
        )
        for array in arrays.values():
            array.clear()
        collision = -1
        if boxes_m:
            collision = pybullet.createCollisionShapeArray(
                shapeTypes=[pybullet.GEOM_BOX] * len(boxes_m),
                halfExtents=[[side / 2 for side in box[3:]] for box in boxes_m],
                collisionFramePositions=[[x, y, height / 2] for x, y, *_, height in boxes_m],
                collisionFrameOrientations=[_about_z(box[2]) for box in boxes_m],
                physicsClientId=self._client,
            )
        body = pybullet.createMultiBody(0.0, collision, visual, physicsClientId=self._client)
        pybullet.changeVisualShape(
            body, -1, textureUniqueId=self._texture, physicsClientId=self._client
        )
        return body

    def add_box(self, length_m: float, width_m: float, height_m: float) -> int:
        """Returns the number of a collision box on the ground, invisible to cameras."""
        half = [length_m / 2, width_m / 2, height_m / 2]
        return self._add_unseen(pybullet.GEOM_BOX, height_m, halfExtents=half)

    def add_cylinder(self, radius_m: float, height_m: float) -> int:
        """Returns the number of an upright collision cylinder, invisible to cameras."""
        return self._add_unseen(pybullet.GEOM_CYLINDER, height_m, radius=radius_m, height=height_m)

    def _add_unseen(self, kind: int, height_m: float, **shape: Any) -> int:
        client = {"physicsClientId": self._client}
        above = [0.0, 0.0, height_m / 2]
        solid = pybullet.createCollisionShape(kind, collisionFramePosition=above, **shape, **client)
        # PyBullet draws a body's collision shape if it has no visual one, so it gets a point.
        corners = {"vertices": [[0.0, 0.0, 0.0]] * 3, "indices": [0, 1, 2]}
        point = pybullet.createVisualShape(pybullet.GEOM_MESH, **corners, **client)
        return pybullet.createMultiBody(1.0, solid, point, **client)

    def place(self, body: int, x_m: float, y_m: float, yaw_rad: float, z_m: float = 0.0) -> None:
        """Places a body at a planar pose."""
        place = (x_m, y_m, z_m), _about_z(yaw_rad)
        pybullet.resetBasePositionAndOrientation(body, *place, self._client)

    def place_at(self, body: int, world_from_body: NDArray[np.float64]) -> None:
        """Places a body anywhere, turned by Rz(yaw) · Ry(pitch)."""
        yaw = math.atan2(-world_from_body[0, 1], world_from_body[1, 1])
        pitch = math.atan2(-world_from_body[2, 0], world_from_body[2, 2])
        turn = pybullet.getQuaternionFromEuler([0.0, pitch, yaw])
        pybullet.resetBasePositionAndOrientation(
            body, world_from_body[:3, 3].tolist(), turn, self._client
        )

    def touch(self, body: int, other: int) -> bool:
        """Returns whether two bodies overlap at their current poses."""
        return bool(pybullet.getClosestPoints(body, other, 0.0, physicsClientId=self._client))

    def look(
        self, view: list[float], projection: list[float], height_px: int, width_px: int
    ) -> Picture:
        """Returns the software renderer's images, without shadows."""
        _, _, rgba, zbuffer, body = pybullet.getCameraImage(
            width_px, height_px, view, projection, physicsClientId=self._client, **_LIGHT
        )
        shape = (height_px, width_px)
        return Picture(
            np.asarray(rgba, dtype=np.uint8).reshape(*shape, 4),
            np.asarray(zbuffer, dtype=np.float32).reshape(shape),
            np.asarray(body, dtype=np.int32).reshape(shape),
        )


def _about_z(yaw_rad: float) -> tuple[float, float, float, float]:
    return 0.0, 0.0, math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad)
