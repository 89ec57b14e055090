"""What a street's camera observes: maps, and motions of camera and bodies since the last step.

The camera itself is `camera:` of the scene's file or of a preset.
"""

from collections.abc import Sequence, Set
from typing import Any, Protocol
from weakref import WeakValueDictionary

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from flowrep.scenes.pedestrians import PARTS, world_from_parts
from flowrep.scenes.scene import MOST_PX, Path, num_classes
from flowrep.simulator.motion import instance_motion, planar, relative_motion, rigid_inverse
from flowrep.simulator.street import Street

Array = NDArray[Any]
Arrays = dict[str, Array]
SENSORS = ("depth", "semantic", "instance", "prev_from_curr", "instance_motion", "rgb", "frame")
EPISODE_SEEDS = 1 << 62  # seeds are smaller; a space of all numbers of int64 can't be sampled
_MAPS = frozenset({"depth", "semantic", "instance"})
_DRAWN = _MAPS | {"rgb"}


class InView(Protocol):
    """What the camera needs to know of an episode at its current step."""

    seed: int
    steps: int
    path: Path
    now: Any  # its `vehicle` is the state now, that of `before` one step ago
    before: Any
    poses: Array  # of people, [P, 4]
    poses_before: Array


class Sensing:
    """The camera of a street and the requested sensors; it draws any number of episodes at once.

    It has no state of an episode, so all envs of a process with the same street and options can
    share one, see `shared`.
    """

    @classmethod
    def shared(cls, street: Street, sensors: Sequence[str], scale: int) -> "Sensing":
        """Returns the one that all envs of the process with these options share."""
        config = street.layout.scene.camera
        most = MOST_PX // max(config.height_px, config.width_px)
        if not hasattr(scale, "__index__") or not 1 <= scale <= most:
            raise ValueError(
                f"picture_scale must be a whole number from 1 to {most}, got {scale!r}"
            )
        names = (sensors,) if isinstance(sensors, str) else tuple(sensors)
        key = street, names, scale
        sensing = _SHARED.get(key)
        if sensing is None:
            sensing = _SHARED[key] = cls(*key)
        return sensing

    def __init__(self, street: Street, sensors: Sequence[str], scale: int) -> None:
        if unknown := [name for name in sensors if name not in SENSORS]:
            raise ValueError(f"unknown sensors {unknown}; they are: {', '.join(SENSORS)}")
        self.names = tuple(sensors)
        self._street, self._scene = street, street.layout.scene
        self._sizes = self._scene.pedestrian_sizes
        config = self._scene.camera
        self._size = config.height_px, config.width_px
        self._range_m = config.near_m, config.far_m
        self.K = config.K
        self._vehicle_from_cam = config.vehicle_from_cam
        self._scale = scale
        self._rasterisers: dict[int, Any] = {}  # by scale
        if not _DRAWN.isdisjoint(sensors):
            self._rasteriser(1)  # so that it is compiled before the first step

    def observe(self, episode: InView) -> dict[str, Any]:
        """Returns an episode's current observation."""
        return {name: arrays[0] for name, arrays in self.observe_all([episode]).items()}

    def observe_all(self, episodes: Sequence[InView]) -> Arrays:
        """Returns the current observations of N episodes, [N, ...], as `observe` returns each."""
        if not self.names:
            return {}
        names, views = _DRAWN.intersection(self.names), self.views(episodes)
        observation = self._draw(views, names) if names else {}
        if not {"prev_from_curr", "instance_motion"}.isdisjoint(self.names):
            now = self._camera_poses([episode.now for episode in episodes])
            before = self._camera_poses([episode.before for episode in episodes])
            if "instance_motion" in self.names:
                parts_before = self._parts([episode.poses_before for episode in episodes])
                # Composed in float64 and rounded once. Row 0 is copied, so that it is contiguous.
                rows = instance_motion(before, now, parts_before, views[1]).astype(np.float32)
                observation |= {"instance_motion": rows, "prev_from_curr": rows[:, 0].copy()}
            else:
                observation["prev_from_curr"] = relative_motion(before, now).astype(np.float32)
        if "frame" in self.names:
            named = [(episode.seed, episode.steps) for episode in episodes]
            observation["frame"] = np.array(named, dtype=np.int64)
        return {name: observation[name] for name in self.names}

    def rgb(self, episode: InView) -> NDArray[np.uint8]:
        """Returns the colour picture [H, W, 3] of an episode's current step."""
        return self._draw(self.views([episode]), {"rgb"})["rgb"][0].transpose(1, 2, 0)

    def space(self) -> spaces.Dict:
        """Returns the observation space."""
        size, parts = self._size, len(PARTS) * self._scene.num_pedestrians
        classes = num_classes(self._scene.categories)
        every: dict[str, spaces.Space] = {
            "depth": spaces.Box(0.0, np.inf, (1, *size), np.float32),
            "semantic": spaces.Box(0, classes - 1, (1, *size), np.uint8),
            "instance": spaces.Box(0, max(parts, 1), (1, *size), np.uint8),
            "prev_from_curr": spaces.Box(-np.inf, np.inf, (4, 4), np.float32),
            "instance_motion": spaces.Box(-np.inf, np.inf, (1 + parts, 4, 4), np.float32),
            "rgb": spaces.Box(0, 255, (3, *(self._scale * side for side in size)), np.uint8),
            "frame": spaces.Box(0, EPISODE_SEEDS - 1, (2,), np.int64),
        }
        return spaces.Dict({name: every[name] for name in self.names})

    def _draw(self, views: tuple[Array, ...], names: Set[str]) -> Arrays:
        """Returns at least the named maps and colours of N views, [N, ...]."""
        arrays = {}
        colours_too = "rgb" in names and self._scale == 1
        if colours_too or not names.isdisjoint(_MAPS):
            drawn = self._rasteriser(1)(*views, rgb=colours_too)
            arrays = {name: getattr(drawn, name)[:, None] for name in _MAPS} | {"rgb": drawn.rgb}
        if "rgb" in names and not colours_too:
            arrays["rgb"] = self._rasteriser(self._scale)(*views, rgb=True).rgb
        return arrays

    def views(self, episodes: Sequence[InView]) -> tuple[Array, Array, Array]:
        """Returns cam_from_world, the poses of people's parts, and which bodies exist, [N, ...]."""
        return (
            rigid_inverse(self._camera_poses([episode.now for episode in episodes])),
            self._parts([episode.poses for episode in episodes]),
            np.stack([self._street.is_shown(episode.path.closures) for episode in episodes]),
        )

    def _parts(self, poses: Sequence[Array]) -> Array:
        return world_from_parts(np.stack(poses), self._sizes)

    def _rasteriser(self, scale: int) -> Any:
        """Returns the rasteriser of pictures of `scale` times the maps' size."""
        if scale not in self._rasterisers:
            from flowrep.simulator.rasteriser import Rasteriser  # which imports numba

            height, width = self._size
            # All rows of K scale alike, because pixel centres are at halves.
            K, size = np.diag([scale, scale, 1.0]) @ self.K, (scale * height, scale * width)
            self._rasterisers[scale] = Rasteriser(self._street.triangles, K, size, self._range_m)
        return self._rasterisers[scale]

    def _camera_poses(self, moments: Sequence[Any]) -> Array:
        """Returns world_from_cam [N, 4, 4]."""
        x_m, y_m, yaw_rad, _ = np.array([moment.vehicle for moment in moments]).T
        return planar(x_m, y_m, yaw_rad) @ self._vehicle_from_cam


_SHARED: WeakValueDictionary[tuple[Any, ...], Sensing] = WeakValueDictionary()
