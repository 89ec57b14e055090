"""What the street's camera observes: maps from one picture, motion from two poses."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from flowrep.envs.camera import (
    depth_from_zbuffer,
    gl_projection,
    gl_view,
    sampled_intrinsics,
    vehicle_from_camera,
)
from flowrep.envs.episode import Episode, Moment
from flowrep.envs.motion import CameraPose, instance_motion, relative_camera
from flowrep.envs.people import PARTS, world_from_parts
from flowrep.envs.scene import Scene
from flowrep.envs.simulator import Picture
from flowrep.envs.street import Street
from flowrep.palette import CLASS_COLOURS, num_classes
from flowrep.simulator.renderer import choose_renderer
from flowrep.simulator.triangles import gather

SENSORS = ("depth", "semantic", "instance", "prev_from_curr", "instance_motion", "rgb")
_MAPS = frozenset({"depth", "semantic", "instance"})
_MOTIONS = frozenset({"prev_from_curr", "instance_motion"})


class Sensing:
    """The camera of one street and the sensors that were asked for."""

    def __init__(
        self, scene: Scene, street: Street, sensors: Sequence[str], renderer: str = "auto"
    ) -> None:
        """Computes what stays the same from picture to picture."""
        unknown = [name for name in sensors if name not in SENSORS]
        if unknown:
            raise ValueError(f"unknown sensors {unknown}; they are: {', '.join(SENSORS)}")
        self.names = tuple(sensors)
        self._scene, self._street, self._camera = scene, street, scene.camera
        camera, focal = scene.camera, scene.camera.focal_px
        size = (camera.height_px, camera.width_px)
        self.K = sampled_intrinsics(focal, focal, *size)
        self._projection = gl_projection(focal, focal, *size, camera.near_m, camera.far_m)
        self._vehicle_from_cam = vehicle_from_camera(camera)
        self._class_of_body = street.simulator.class_lookup()
        self._instance_of_body = street.simulator.instance_lookup()
        self._rasterise: Any = None
        if not _MAPS.isdisjoint(sensors) and choose_renderer(renderer) == "rasteriser":
            from flowrep.simulator.rasteriser import Rasteriser

            range_m = camera.near_m, camera.far_m
            self._rasterise = Rasteriser(gather(street.bodies), self.K, size, range_m)
        self._picture: Picture | None = None
        self._latest_parts: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
        self._camera_poses: dict[Moment, CameraPose] = {}

    def observe(self, episode: Episode) -> dict[str, Any]:
        """Returns the observation of an episode's present; nothing is rendered for no map."""
        self._picture = None
        observation: dict[str, Any] = {}
        if not _MAPS.isdisjoint(self.names):
            draw = self._add_pictured_maps if self._rasterise is None else self._add_maps
            draw(observation, episode)
        if "rgb" in self.names:
            rgb = self._rgb(self._seen(episode))
            observation["rgb"] = np.ascontiguousarray(rgb.transpose(2, 0, 1))
        if not _MOTIONS.isdisjoint(self.names):
            self._add_motion(observation, episode)
        return {name: observation[name] for name in self.names}

    def rgb(self, episode: Episode) -> NDArray[np.uint8]:
        """Returns the colour picture [H, W, 3] of an episode's present, last observed."""
        return self._rgb(self._seen(episode))

    def look(self, episode: Episode) -> Picture:
        """Returns a picture of an episode's present, with everyone where they were last put."""
        camera, view = self._camera, gl_view(self._camera_pose(episode.now).cam_from_world)
        return self._street.simulator.look(
            view, self._projection, camera.height_px, camera.width_px
        )

    def space(self) -> spaces.Dict:
        """Returns the observation space."""
        size = (self._camera.height_px, self._camera.width_px)
        parts = len(PARTS) * self._scene.num_pedestrians
        classes = num_classes(self._scene.categories)
        every: dict[str, spaces.Space] = {
            "depth": spaces.Box(0.0, np.inf, (1, *size), np.float32),
            "semantic": spaces.Box(0, classes - 1, (1, *size), np.uint8),
            "instance": spaces.Box(0, max(parts, 1), (1, *size), np.uint8),
            "prev_from_curr": spaces.Box(-np.inf, np.inf, (4, 4), np.float32),
            "instance_motion": spaces.Box(-np.inf, np.inf, (1 + parts, 4, 4), np.float32),
            "rgb": spaces.Box(0, 255, (3, *size), np.uint8),
        }
        return spaces.Dict({name: every[name] for name in self.names})

    def _seen(self, episode: Episode) -> Picture:
        if self._picture is None:
            self._street.place_pedestrians(episode.poses, episode.now.vehicle)
            self._picture = self.look(episode)
        return self._picture

    def _camera_pose(self, moment: Moment) -> CameraPose:
        # The poses of this step and of the one before are at hand.
        if moment not in self._camera_poses:
            x_m, y_m, yaw_rad, _ = moment.vehicle
            if len(self._camera_poses) > 1:
                self._camera_poses.pop(next(iter(self._camera_poses)))
            self._camera_poses[moment] = CameraPose(x_m, y_m, yaw_rad, self._vehicle_from_cam)
        return self._camera_poses[moment]

    def _parts(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        # This step's poses are, as the very same array, the next one's poses of before.
        for known, parts in self._latest_parts:
            if known is poses:
                return parts
        parts = world_from_parts(poses)
        self._latest_parts = [*self._latest_parts[-1:], (poses, parts)]
        return parts

    def _add_maps(self, observation: dict[str, Any], episode: Episode) -> None:
        cam_from_world = self._camera_pose(episode.now).cam_from_world
        views = cam_from_world, self._parts(episode.poses), self._street.is_shown
        observation.update(self._rasterise(*(array[None] for array in views))._asdict())

    def _add_pictured_maps(self, observation: dict[str, Any], episode: Episode) -> None:
        picture = self._seen(episode)
        body = picture.body.astype(np.intp)  # what take() wants
        if "depth" in self.names:
            depth = depth_from_zbuffer(picture.zbuffer, self._camera.near_m, self._camera.far_m)
            np.putmask(depth, body < 0, np.inf)
            observation["depth"] = depth[None]
        if "semantic" in self.names:
            observation["semantic"] = self._class_of_body.take(body)[None]
        if "instance" in self.names:
            observation["instance"] = self._instance_of_body.take(body)[None]

    def _rgb(self, picture: Picture) -> NDArray[np.uint8]:
        rgb = picture.rgba[..., :3].copy()
        rgb[picture.body < 0] = CLASS_COLOURS["sky"]
        return rgb

    def _add_motion(self, observation: dict[str, Any], episode: Episode) -> None:
        before, now = self._camera_pose(episode.before), self._camera_pose(episode.now)
        if "instance_motion" in self.names:
            parts = [self._parts(poses) for poses in (episode.poses_before, episode.poses)]
            rows = instance_motion(before, now, *parts)
            observation["instance_motion"] = rows.astype(np.float32)
            observation["prev_from_curr"] = observation["instance_motion"][0].copy()
        else:
            observation["prev_from_curr"] = relative_camera(before, now).astype(np.float32)
