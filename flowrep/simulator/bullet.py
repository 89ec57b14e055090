"""Bodies, collisions and pictures by PyBullet; no other module imports it.

Each simulator has a DIRECT client of its own, disconnected by `close()` or at garbage collection.
"""

import contextlib
import functools
import math
import os
import tempfile
import weakref
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.palette import CATEGORY_ID
from flowrep.simulator.meshes import Mesh
from flowrep.simulator.paint import AMBIENT, DIFFUSE, LIGHT


@contextlib.contextmanager
def _without_greeting() -> Iterator[None]:
    """Suppresses the build time that PyBullet prints to stderr when it is imported."""
    stderr = os.dup(2)
    try:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


with _without_greeting():
    import pybullet

_LIGHT = {
    "lightDirection": list(LIGHT),
    "lightColor": [1.0, 1.0, 1.0],
    "lightAmbientCoeff": AMBIENT,
    "lightDiffuseCoeff": DIFFUSE,
    "lightSpecularCoeff": 0.0,
    "shadow": 0,
    "renderer": pybullet.ER_TINY_RENDERER,
}
_HIDDEN_Z_M = -1000.0


@functools.cache
def _shared(value: Any) -> Any:
    return value


class Picture(NamedTuple):
    """The camera's images, all [H, W] except `rgba` [H, W, 4]."""

    rgba: NDArray[np.uint8]
    zbuffer: NDArray[np.float32]
    body: NDArray[np.int32]  # -1 for no body


class Simulator:
    """A world of bodies that stay where they are placed; no dynamics are simulated."""

    def __init__(self, texture_rgb: NDArray[np.uint8]) -> None:
        """Connects, and loads the texture [S, S, 3] shared by all meshes."""
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise RuntimeError("PyBullet gave no client: close some environments first")
        self._finalizer = weakref.finalize(self, pybullet.disconnect, self._client)
        self._texture = self._load_texture(texture_rgb)
        self._class_of_body: list[int] = []
        self._instance_of_body: list[int] = []
        self._vehicle = -1
        self._vehicle_half_height_m = 0.0

    def close(self) -> None:
        """Disconnects the client; further calls do nothing."""
        self._finalizer()

    def add_body(
        self,
        mesh: Mesh,
        category: str,
        *,
        instance: int = 0,
        boxes_m: tuple[tuple[float, float, float, float, float, float], ...] = (),
    ) -> int:
        """Returns the number of a new body at the origin.

        Args:
            mesh: its visible geometry.
            category: its class in the semantic map.
            instance: its id in the instance map; 0 for the static world.
            boxes_m: collision boxes (x, y, yaw, length, width, height), standing on the ground.
        """
        arrays = {
            "vertices": [_shared(tuple(row)) for row in mesh.vertices],
            "indices": [_shared(index) for index in mesh.indices],
            "normals": [_shared(tuple(row)) for row in mesh.normals],
            "uvs": [_shared(tuple(row)) for row in mesh.uvs],
        }
        visual = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            rgbaColor=[1.0, 1.0, 1.0, 1.0],
            physicsClientId=self._client,
            **arrays,
        )
        # PyBullet leaks the lists that it is given and their items. These lists end up empty, and
        # the numbers are the same objects for every client of the process.
        for array in arrays.values():
            array.clear()
        collision = self._collision_shape(boxes_m)
        body = pybullet.createMultiBody(
            0.0, collision, visual, [0.0, 0.0, 0.0], physicsClientId=self._client
        )
        pybullet.changeVisualShape(
            body, -1, textureUniqueId=self._texture, physicsClientId=self._client
        )
        self._register(body, category, instance)
        return body

    def add_vehicle(self, length_m: float, width_m: float, height_m: float) -> None:
        """Adds the vehicle: a collision box that is invisible to cameras."""
        half = [length_m / 2, width_m / 2, height_m / 2]
        collision = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=half, physicsClientId=self._client
        )
        self._vehicle = self._add_unseen(collision)
        self._vehicle_half_height_m = height_m / 2

    def add_cylinder(self, radius_m: float, height_m: float) -> int:
        """Returns the number of an upright collision cylinder, invisible to cameras."""
        return self._add_unseen(
            pybullet.createCollisionShape(
                pybullet.GEOM_CYLINDER,
                radius=radius_m,
                height=height_m,
                collisionFramePosition=[0.0, 0.0, height_m / 2],
                physicsClientId=self._client,
            )
        )

    def _add_unseen(self, collision: int) -> int:
        # PyBullet draws a body's collision shape if it has no visual one, so it gets a point.
        point = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=[[0.0, 0.0, 0.0]] * 3,
            indices=[0, 1, 2],
            physicsClientId=self._client,
        )
        body = pybullet.createMultiBody(
            1.0, collision, point, [0.0, 0.0, 0.0], physicsClientId=self._client
        )
        self._register(body, "sky", 0)
        return body

    def class_lookup(self) -> NDArray[np.uint8]:
        """Returns class ids by body number; the last entry, which index -1 reads, is the sky."""
        return np.array([*self._class_of_body, CATEGORY_ID["sky"]], dtype=np.uint8)

    def instance_lookup(self) -> NDArray[np.uint8]:
        """Returns instance ids by body number; the last entry, which index -1 reads, is 0."""
        return np.array([*self._instance_of_body, 0], dtype=np.uint8)

    def place(self, body: int, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Places a body on the ground at a planar pose."""
        half = 0.5 * yaw_rad
        pybullet.resetBasePositionAndOrientation(
            body,
            (x_m, y_m, 0.0),
            (0.0, 0.0, math.sin(half), math.cos(half)),
            physicsClientId=self._client,
        )

    def place_all(
        self,
        bodies: list[int],
        positions: NDArray[np.float64],
        quaternions_xyzw: NDArray[np.float64],
    ) -> None:
        """Places N bodies at positions [N, 3] and orientations [N, 4]."""
        put, client = pybullet.resetBasePositionAndOrientation, self._client
        for body, position, turn in zip(bodies, positions.tolist(), quaternions_xyzw.tolist()):
            put(body, position, turn, client)

    def hide(self, body: int) -> None:
        """Moves a body out of reach of the camera and the vehicle."""
        pybullet.resetBasePositionAndOrientation(
            body, (0.0, 0.0, _HIDDEN_Z_M), (0.0, 0.0, 0.0, 1.0), physicsClientId=self._client
        )

    def place_vehicle(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Places the vehicle's footprint at a planar pose."""
        half = 0.5 * yaw_rad
        pybullet.resetBasePositionAndOrientation(
            self._vehicle,
            (x_m, y_m, self._vehicle_half_height_m),
            (0.0, 0.0, math.sin(half), math.cos(half)),
            physicsClientId=self._client,
        )

    def vehicle_touches(self, body: int) -> bool:
        """Returns whether the vehicle and a body overlap at their current poses."""
        return bool(
            pybullet.getClosestPoints(self._vehicle, body, 0.0, physicsClientId=self._client)
        )

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

    def _collision_shape(
        self, boxes_m: tuple[tuple[float, float, float, float, float, float], ...]
    ) -> int:
        if not boxes_m:
            return -1
        return pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX] * len(boxes_m),
            halfExtents=[[box[3] / 2, box[4] / 2, box[5] / 2] for box in boxes_m],
            collisionFramePositions=[[box[0], box[1], box[5] / 2] for box in boxes_m],
            collisionFrameOrientations=[
                [0.0, 0.0, math.sin(box[2] / 2), math.cos(box[2] / 2)] for box in boxes_m
            ],
            physicsClientId=self._client,
        )

    def _register(self, body: int, category: str, instance: int) -> None:
        # PyBullet numbers a client's bodies from 0, so the lists serve as lookup tables.
        if body != len(self._class_of_body):
            raise RuntimeError(f"PyBullet numbered body {len(self._class_of_body)} as {body}")
        self._class_of_body.append(CATEGORY_ID[category])
        self._instance_of_body.append(instance)

    def _load_texture(self, rgb: NDArray[np.uint8]) -> int:
        # PyBullet reads textures only from files, with v counted upwards from the bottom row. A TGA
        # file is an 18-byte header and the pixels as BGR.
        height, width, _ = rgb.shape
        size = width.to_bytes(2, "little") + height.to_bytes(2, "little")
        header = bytes([0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0]) + size + bytes([24, 0x20])
        handle, path = tempfile.mkstemp(suffix=".tga")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(header + rgb[::-1, :, ::-1].tobytes())
            return pybullet.loadTexture(path, physicsClientId=self._client)
        finally:
            os.unlink(path)
