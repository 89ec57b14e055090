"""The gymnasium environment."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from flowrep.envs.camera import (
    depth_from_zbuffer,
    gl_projection,
    gl_view,
    sampled_intrinsics,
    vehicle_from_camera,
)
from flowrep.envs.episode import Episode, Moment, Rules
from flowrep.envs.layout import Layout
from flowrep.envs.loading import load_scene
from flowrep.envs.motion import CameraPose, instance_motion, relative_camera
from flowrep.envs.outcome import Outcome, reward
from flowrep.envs.palette import PALETTE_RGB, num_classes
from flowrep.envs.scene import Range, Scene, SpeedMode
from flowrep.envs.simulator import Picture, Simulator
from flowrep.envs.street import Street
from flowrep.envs.vehicle import VehicleState

SENSORS = ("depth", "semantic", "instance", "prev_from_curr", "instance_motion", "rgb")
_MAP_SENSORS = frozenset({"depth", "semantic", "instance", "rgb"})


class StreetEnv(gym.Env):
    """A vehicle drives through a street of pedestrians at constant speed, and steers.

    Actions: 0 keeps the yaw rate, 1 adds α·Δt to it (left), 2 takes it off (right).

    Observation: a dict with the `sensors` that were asked for.

    | key | shape | dtype | what |
    | --- | --- | --- | --- |
    | `depth` | [1, H, W] | float32 | metres along z; sky is inf |
    | `semantic` | [1, H, W] | uint8 | class id, see `flowrep.envs.palette` |
    | `instance` | [1, H, W] | uint8 | pedestrian's number from 1; 0 is the static world |
    | `prev_from_curr` | [4, 4] | float32 | current camera to previous camera |
    | `instance_motion` | [1 + P, 4, 4] | float32 | the same by instance; row 0: static world |
    | `rgb` | [3, H, W] | uint8 | |

    At reset the previous pose is the current one. `info` holds `outcome`, `hit` (the category of
    what was hit, or ""), `episode_seed` and `path`.

    Args:
        scene: a scene's name, file, mapping, or `Scene`.
        speed: the pedestrians' speed mode, or their (lowest, highest) speed in m/s.
        frame_rate_hz: steps a second; the scene's own if None. The time limit keeps its seconds.
        sensors: the keys of the observation; with none nothing is rendered.
        render_mode: "rgb_array" or None.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - gymnasium declares it so
        "render_modes": ["rgb_array"],
        "render_fps": 12,
    }

    def __init__(
        self,
        scene: str | Path | Mapping[str, Any] | Scene = "straight_road",
        speed: SpeedMode | Range = "normal",
        frame_rate_hz: float | None = None,
        sensors: Sequence[str] = SENSORS[:5],
        render_mode: str | None = None,
    ) -> None:
        """Builds the street; the first `reset` begins an episode."""
        self.scene = load_scene(scene)
        self.speed_mps = _speed_range(self.scene, speed)
        self.frame_rate_hz = _frame_rate(self.scene, frame_rate_hz)
        self.sensors = _known_sensors(sensors)
        self.render_mode = _render_mode(render_mode)
        self.metadata = {**self.metadata, "render_fps": self.frame_rate_hz}
        camera = self.scene.camera
        height, width, focal = camera.height_px, camera.width_px, camera.focal_px
        self.K = sampled_intrinsics(focal, focal, height, width)
        self.num_classes = num_classes(self.scene.categories)
        self._projection = gl_projection(focal, focal, height, width, camera.near_m, camera.far_m)
        self._vehicle_from_cam = vehicle_from_camera(camera)
        self._rules = Rules(Layout(self.scene), self.frame_rate_hz)
        self._street = Street(self._rules.layout)
        self._class_of_body = self.simulator.class_lookup()
        self._instance_of_body = self.simulator.instance_lookup()
        self._episode: Episode | None = None
        self._picture: Picture | None = None
        self._camera_poses: dict[Moment, CameraPose] = {}
        self.action_space = spaces.Discrete(3)
        self.observation_space = self._observation_space()

    @property
    def episode(self) -> Episode:
        """The running episode, with every pose: what a privileged policy may see."""
        if self._episode is None:
            raise RuntimeError("there is no episode yet: call reset() first")
        return self._episode

    @property
    def simulator(self) -> Simulator:
        """The world of bodies that the camera looks at."""
        return self._street.simulator

    def camera_pose(self) -> CameraPose:
        """Returns where the camera stands."""
        return self._camera_pose(self.episode.now)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: seeds the generator that draws the episodes' seeds.
            options: `episode_seed` (int) names the episode, `path` (str) its path,
                `vehicle_speed_mps` (float) another speed than the scene's: 0 holds the camera.
        """
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(1 << 31))
        options = dict(options or {})
        episode_seed = int(options.pop("episode_seed", drawn))
        self._begin(episode_seed, options.pop("path", None), options.pop("vehicle_speed_mps", None))
        if options:
            known = "episode_seed, path, vehicle_speed_mps"
            raise ValueError(f"unknown reset options {sorted(options)}; they are: {known}")
        return self._observe(), self._info()

    def step(self, action: int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drives one step. Every end of an episode is `terminated`, the time-out too."""
        if self.episode.outcome:
            label = self.episode.outcome.label
            raise RuntimeError(f"the episode has ended ({label}): call reset() first")
        self.episode.step(int(action), self._street)
        outcome = self.episode.outcome
        observation = self._observe()
        return observation, reward(outcome), outcome != Outcome.RUNNING, False, self._info()

    def render(self) -> Any:
        """Returns what the camera sees, [H, W, 3] uint8, if the render mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        return self._rgb(self._look())

    def close(self) -> None:
        """Gives the simulator's client back."""
        self.simulator.close()

    def get_state(self) -> dict[str, Any]:
        """Returns all that the future depends on, as plain data that JSON can hold."""
        episode = self.episode
        return {
            "np_random": self.np_random.bit_generator.state,
            "episode_seed": episode.seed,
            "path": episode.path.name,
            "vehicle_speed_mps": episode.vehicle_speed_mps,
            "steps": episode.steps,
            "outcome": episode.outcome.label,
            "hit": episode.hit,
            "now": _plain(episode.now),
            "before": _plain(episode.before),
        }

    def set_state(self, state: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Goes back to a state of `get_state`; returns its observation and info."""
        self.np_random.bit_generator.state = state["np_random"]
        self._begin(state["episode_seed"], state["path"], state["vehicle_speed_mps"])
        episode = self.episode
        episode.steps, episode.hit = state["steps"], state["hit"]
        episode.outcome = Outcome[state["outcome"].upper()]
        episode.resume(_moment(state["before"]), _moment(state["now"]))
        return self._observe(), self._info()

    def _begin(self, seed: int, path: str | None, vehicle_speed_mps: float | None) -> None:
        self._episode = Episode(
            self._rules, seed, self.speed_mps, path=path, vehicle_speed_mps=vehicle_speed_mps
        )
        self._street.close_exits(self._episode.path.closures)

    def _info(self) -> dict[str, Any]:
        episode = self.episode
        return {
            "outcome": episode.outcome.label,
            "hit": episode.hit,
            "episode_seed": episode.seed,
            "path": episode.path.name,
        }

    def _observe(self) -> dict[str, Any]:
        self._picture = None
        if not self.sensors:
            return {}
        observation: dict[str, Any] = {}
        if not _MAP_SENSORS.isdisjoint(self.sensors):
            self._add_maps(observation, self._look())
        if "prev_from_curr" in self.sensors or "instance_motion" in self.sensors:
            self._add_motion(observation)
        return {name: observation[name] for name in self.sensors}

    def _look(self) -> Picture:
        if self._picture is None:
            now, camera = self.episode.now, self.scene.camera
            self._street.place_pedestrians(self.episode.poses)
            view = gl_view(self._camera_pose(now).cam_from_world)
            self._picture = self.simulator.look(
                view, self._projection, camera.height_px, camera.width_px
            )
        return self._picture

    def _camera_pose(self, moment: Moment) -> CameraPose:
        # The poses of this step and of the one before are at hand.
        if moment not in self._camera_poses:
            x_m, y_m, yaw_rad, _ = moment.vehicle
            if len(self._camera_poses) > 1:
                self._camera_poses.pop(next(iter(self._camera_poses)))
            self._camera_poses[moment] = CameraPose(x_m, y_m, yaw_rad, self._vehicle_from_cam)
        return self._camera_poses[moment]

    def _add_maps(self, observation: dict[str, Any], picture: Picture) -> None:
        body = picture.body.astype(np.intp)  # what take() wants
        if "depth" in self.sensors:
            camera = self.scene.camera
            depth = depth_from_zbuffer(picture.zbuffer, camera.near_m, camera.far_m)
            np.putmask(depth, body < 0, np.inf)
            observation["depth"] = depth[None]
        if "semantic" in self.sensors:
            observation["semantic"] = self._class_of_body.take(body)[None]
        if "instance" in self.sensors:
            observation["instance"] = self._instance_of_body.take(body)[None]
        if "rgb" in self.sensors:
            observation["rgb"] = np.ascontiguousarray(self._rgb(picture).transpose(2, 0, 1))

    def _rgb(self, picture: Picture) -> np.ndarray:
        rgb = picture.rgba[..., :3].copy()
        rgb[picture.body < 0] = PALETTE_RGB[0]
        return rgb

    def _add_motion(self, observation: dict[str, Any]) -> None:
        episode = self.episode
        before, now = self._camera_pose(episode.before), self._camera_pose(episode.now)
        if "instance_motion" in self.sensors:
            rows = instance_motion(before, now, episode.poses_before, episode.poses)
            rows = rows.astype(np.float32)
            observation["instance_motion"] = rows
            observation["prev_from_curr"] = rows[0].copy()
        else:
            observation["prev_from_curr"] = relative_camera(before, now).astype(np.float32)

    def _observation_space(self) -> spaces.Dict:
        size = (self.scene.camera.height_px, self.scene.camera.width_px)
        people = self.scene.num_pedestrians
        every: dict[str, spaces.Space] = {
            "depth": spaces.Box(0.0, np.inf, (1, *size), np.float32),
            "semantic": spaces.Box(0, self.num_classes - 1, (1, *size), np.uint8),
            "instance": spaces.Box(0, max(people, 1), (1, *size), np.uint8),
            "prev_from_curr": spaces.Box(-np.inf, np.inf, (4, 4), np.float32),
            "instance_motion": spaces.Box(-np.inf, np.inf, (1 + people, 4, 4), np.float32),
            "rgb": spaces.Box(0, 255, (3, *size), np.uint8),
        }
        return spaces.Dict({name: every[name] for name in self.sensors})


def _speed_range(scene: Scene, speed: SpeedMode | Range) -> Range:
    if isinstance(speed, str):
        if speed not in scene.pedestrian_speed_mps:
            modes = ", ".join(scene.pedestrian_speed_mps)
            raise ValueError(f"unknown speed {speed!r}; choose one of {modes}, or give (low, high)")
        return scene.pedestrian_speed_mps[speed]
    low, high = (float(bound) for bound in speed)
    if not 0 <= low <= high:
        raise ValueError(f"speed is ({low}, {high}) m/s; give (lowest, highest), from 0")
    return low, high


def _frame_rate(scene: Scene, frame_rate_hz: float | None) -> float:
    rate = scene.frame_rate_hz if frame_rate_hz is None else float(frame_rate_hz)
    if not rate > 0:
        raise ValueError(f"frame_rate_hz is {rate}; give a rate above 0, say 12")
    return rate


def _known_sensors(sensors: Sequence[str]) -> tuple[str, ...]:
    unknown = [name for name in sensors if name not in SENSORS]
    if unknown:
        raise ValueError(f"unknown sensors {unknown}; they are: {', '.join(SENSORS)}")
    return tuple(sensors)


def _render_mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"unknown render_mode {render_mode!r}; give 'rgb_array' or None")
    return render_mode


def _plain(moment: Moment) -> dict[str, Any]:
    return {"vehicle": [float(value) for value in moment.vehicle], "ticks": moment.ticks}


def _moment(plain: Mapping[str, Any]) -> Moment:
    return Moment(VehicleState(*plain["vehicle"]), plain["ticks"])
