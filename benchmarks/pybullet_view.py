"""A street drawn by PyBullet's software renderer, with which the rasteriser is compared."""

import math
from typing import Any

import numpy as np
import pybullet
from numpy.typing import NDArray

from flowrep.pybullet import BulletCamera
from flowrep.scenes.scene import CameraConfig
from flowrep.simulator.street import Street

_HIDDEN_M = -1000.0  # height of absent bodies


class PyBulletView:
    """What PyBullet's software renderer shows of a street, without colours."""

    def __init__(self, street: Street, camera: CameraConfig) -> None:
        self._bodies, self._client = street.bodies, pybullet.connect(pybullet.DIRECT)
        self._numbers = []
        for body in street.bodies:
            points = body.corners.reshape(-1, 3)
            shape = {"vertices": points.tolist(), "indices": list(range(len(points)))}
            shape |= {"shapeType": pybullet.GEOM_MESH, "physicsClientId": self._client}
            seen = pybullet.createVisualShape(**shape)
            self._numbers.append(
                pybullet.createMultiBody(0, -1, seen, physicsClientId=self._client)
            )
        self.camera = BulletCamera(
            self._client,
            camera.width_px,
            camera.height_px,
            fov_deg=camera.fov_deg,
            near_m=camera.near_m,
            far_m=camera.far_m,
            max_instances=len(street.bodies),
            classes={n: body.semantic for n, body in zip(self._numbers, street.bodies)},
        )

    def place(self, world_from_part: NDArray[Any], is_shown: NDArray[np.bool_]) -> None:
        """Places people's parts at poses [M, 4, 4], and hides what is not shown, bool [B]."""
        poses = iter(world_from_part)
        for number, body, shown in zip(self._numbers, self._bodies, is_shown):
            pose = next(poses) if body.instance else np.eye(4)
            # Rz(yaw) · Ry(pitch)
            yaw = math.atan2(-pose[0, 1], pose[1, 1])
            pitch = math.atan2(-pose[2, 0], pose[2, 2])
            turn = pybullet.getQuaternionFromEuler([0.0, pitch, yaw])
            at = pose[:3, 3].tolist() if shown else (0.0, 0.0, _HIDDEN_M)
            pybullet.resetBasePositionAndOrientation(number, at, turn, self._client)

    def maps(self, cam_from_world: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Returns depth, classes and instances [1, H, W], as a `StreetEnv` observes them."""
        seen = self.camera.reset(_view(cam_from_world))
        instance_of = np.zeros(1 + len(self._bodies), dtype=np.uint8)  # by the camera's rows
        for number, body in zip(self._numbers, self._bodies):
            instance_of[self.camera.rows[number, -1]] = body.instance
        return seen | {"instance": instance_of[seen["instance"]]}

    def look(self, cam_from_world: NDArray[Any]) -> Any:
        """Takes a picture by a bare call of PyBullet."""
        size, view = (self.camera.width, self.camera.height), _view(cam_from_world)
        client = {"physicsClientId": self._client}
        return pybullet.getCameraImage(*size, view, **self.camera._picture, **client)

    def close(self) -> None:
        """Ends the world."""
        pybullet.disconnect(self._client)


def _view(cam_from_world: NDArray[Any]) -> list[float]:
    return (np.diag([1.0, -1.0, -1.0, 1.0]) @ cam_from_world).T.ravel().tolist()
