"""The gymnasium env of a street: what a step does, when an episode ends, its reward."""

import math
from collections.abc import Mapping, Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import shapely
from gymnasium import spaces
from numpy.typing import NDArray

from flowrep.config.options import FRAME_RATES_HZ, SpeedMode
from flowrep.envs.sensing import EPISODE_SEEDS, SENSORS, Sensing
from flowrep.scenes.layout import Layout
from flowrep.scenes.load import load_scene
from flowrep.scenes.pedestrians import Crowd, draw_crowd
from flowrep.scenes.scene import CATEGORIES, CATEGORY_ID, Range, Scene, check_speed, num_classes
from flowrep.scenes.vehicle import YAW_SIGN, VehicleState, footprint_corners, roll, turn
from flowrep.simulator.street import Street

Array = NDArray[Any]


class Outcome(IntEnum):
    """The state of an episode; the TensorDict holds its code."""

    RUNNING = 0
    SUCCESS = 1
    COLLISION = 2
    OUT_OF_BOUNDS = 3
    TIMEOUT = 4

    @property
    def label(self) -> str:
        """Its name in `info`, tables and files."""
        return self.name.lower()


NOTHING_HIT = 255  # value of `hit` without a collision; no class has this id


def reward(outcome: Outcome) -> float:
    """Returns the reward of a step that leads to `outcome`."""
    return 0.01 + {Outcome.RUNNING: 0.0, Outcome.SUCCESS: 5.0}.get(outcome, -5.0)


def hit_name(code: int) -> str:
    """Returns the category of a code of `hit`, or "" for nothing."""
    return "" if code == NOTHING_HIT else CATEGORIES[code]


# Between two tests of the footprint, neither the vehicle nor a person moves more than 0.42 m (the
# vehicle at 10 m/s), and a shorter vehicle not more than its length. So it can't jump over
# anything.
_CHECKS_HZ = 24.0
_CHECKS_PER_M = 2.4
# People ignore the vehicle, so their poses are computed for many steps at once. Computed at each
# step they would take 60 of 650 us of a step with maps.
_STEPS_AHEAD = 16


class Moment(NamedTuple):
    """The vehicle's state and the pedestrians' clock in ticks; each tick tests the footprint."""

    vehicle: VehicleState
    ticks: int


def ticks_for(scene: Scene, frame_rate_hz: float, speed_mps: Range, driven_mps: float) -> int:
    """Returns how many times a step tests the footprint, at the speeds of an episode."""
    groups = [group for group in scene.pedestrian_groups if group.standing < group.count]
    fastest_mps = max(((group.speed_mps or speed_mps)[1] for group in groups), default=0.0)
    check_speed("speed", fastest_mps, scene.camera, frame_rate_hz)
    check_speed("vehicle_speed_mps", driven_mps, scene.camera, frame_rate_hz)
    driven_hz = driven_mps * max(_CHECKS_PER_M, 1.0 / scene.vehicle.length_m)
    checks_hz = max(_CHECKS_HZ, driven_hz, fastest_mps * _CHECKS_PER_M)
    return math.ceil(checks_hz / frame_rate_hz - 1e-9)


class Episode:
    """One drive through a scene: positions, outcome and reward, without rendering.

    It is a function of the scene, the speed range, the frame rate, its seed and the actions.

    Args:
        layout: the ground plan of the scene.
        frame_rate_hz: steps a second.
        episode_seed: seed of everything that is drawn: the path, and how people walk.
        speed_mps: lowest and highest speed of people whose group doesn't set its speed.
        vehicle_speed_mps: the speed at which the vehicle drives.
        path: the name of the path; None draws one.

    Raises:
        ValueError: the scene has no such path.
    """

    def __init__(
        self,
        layout: Layout,
        frame_rate_hz: float,
        episode_seed: int,
        speed_mps: Range,
        vehicle_speed_mps: float,
        path: str | None = None,
    ) -> None:
        scene = layout.scene
        paths = {each.name: each for each in scene.paths}
        if path not in (None, *paths):
            raise ValueError(f"unknown path {path!r}; the scene has {[*paths]}")
        # A seed's episode depends on the order of the draws: first the path, then the people.
        rng = np.random.default_rng(episode_seed)
        # Draw even if a path is given, so that a seed has the same people on every path.
        drawn = scene.paths[int(rng.integers(len(scene.paths)))]
        self.layout, self.seed = layout, episode_seed
        self.speed_mps, self.vehicle_speed_mps = speed_mps, vehicle_speed_mps
        self.frame_rate_hz, self.dt_s = frame_rate_hz, 1.0 / frame_rate_hz
        self.ticks_per_step = ticks_for(scene, frame_rate_hz, speed_mps, vehicle_speed_mps)
        self.tick_s = self.dt_s / self.ticks_per_step
        # Rounding must not add a step: 200 / 12 · 15 is 250.00000000000003.
        self.limit_steps = math.ceil(scene.time_limit_s * frame_rate_hz - 1e-9)
        self.path = drawn if path is None else paths[path]
        self.crowd: Crowd = draw_crowd(layout, speed_mps, rng)
        self.goal = layout.zones[self.path.end]
        self.now = self.before = Moment(layout.start_state(self.path.start), 0)
        self.steps, self.outcome, self.hit = 0, Outcome.RUNNING, ""
        self.poses = self.poses_before = self.crowd.poses(0.0)
        # Poses of people at consecutive ticks, [ticks, P, 4], and the first of these ticks.
        self._ahead_from, self._ahead = 0, self.poses[:0, None]

    def status(self) -> dict[str, int]:
        """Returns outcome, hit, seed and path as numbers, for TensorDicts."""
        return {
            "outcome": int(self.outcome),
            "hit": CATEGORY_ID[self.hit] if self.hit else NOTHING_HIT,
            "episode_seed": self.seed,
            "path": self.layout.scene.paths.index(self.path),
        }

    def resume(self, before: Moment, now: Moment) -> None:
        """Jumps to a later step, given its moment and the one before it."""
        self.before, self.now = before, now
        self.poses_before = self.crowd.poses(before.ticks * self.tick_s)
        self.poses = self.crowd.poses(now.ticks * self.tick_s)

    def step(self, action: int, street: Street) -> None:
        """Drives one step, or part of it if the episode ends."""
        # The yaw rate changes once, at the beginning. Then the vehicle drives along an arc, on
        # which the footprint is tested at every tick.
        turned = turn(self.now.vehicle, YAW_SIGN[action], self.dt_s, self.layout.scene.vehicle)
        times_s = [(1 + i) * self.tick_s for i in range(self.ticks_per_step)]
        track = [roll(turned, time_s, self.vehicle_speed_mps) for time_s in times_s]
        poses = self._poses_ahead()
        is_near = street.is_anyone_near(track, poses).tolist()
        for i, vehicle in enumerate(track):
            # Call PyBullet and shapely only where a collision or an end is possible.
            if is_near[i] or not street.is_safe(vehicle.x_m, vehicle.y_m):
                self._end_where_due(vehicle, poses[i], street)
            if self.outcome:
                break
        self.before, self.now = self.now, Moment(vehicle, self.now.ticks + i + 1)
        self.poses_before, self.poses = self.poses, poses[i]
        self.steps += 1
        if not self.outcome and self.steps >= self.limit_steps:
            self.outcome = Outcome.TIMEOUT

    def _poses_ahead(self) -> Array:  # at the checks of the next step, [T, P, 4]
        count, first = self.ticks_per_step, self.now.ticks + 1
        at = first - self._ahead_from
        if not 0 <= at <= len(self._ahead) - count:
            ticks = first + np.arange(count * _STEPS_AHEAD)
            self._ahead = self.crowd.poses(ticks[:, None] * self.tick_s)
            self._ahead_from, at = first, 0
        return self._ahead[at : at + count]

    def _end_where_due(self, vehicle: VehicleState, poses: Array, street: Street) -> None:
        self.hit = street.hit(vehicle, poses, self.path.closures)
        footprint = shapely.Polygon(footprint_corners(vehicle, self.layout.scene.vehicle))
        if self.hit:
            self.outcome = Outcome.COLLISION
        elif not self.layout.drivable.covers(footprint):
            self.outcome = Outcome.OUT_OF_BOUNDS
        elif shapely.contains_xy(self.goal, vehicle.x_m, vehicle.y_m):
            self.outcome = Outcome.SUCCESS


_OPTIONS = ("episode_seed", "path", "vehicle_speed_mps", "speed", "frame_rate_hz")


class StreetEnv(gym.Env):
    """The agent steers a vehicle at constant speed through a street with pedestrians.

    Actions: 0 keeps the yaw rate, 1 adds α·Δt to it (left), 2 subtracts α·Δt (right).

    Observation: a dict of the requested `sensors`.

    | key | shape | dtype | meaning |
    | --- | --- | --- | --- |
    | `depth` | [1, H, W] | float32 | metres along z; sky is inf |
    | `semantic` | [1, H, W] | uint8 | class id, see `flowrep.scenes.CATEGORY_ID` |
    | `instance` | [1, H, W] | uint8 | 0: static world; 1, 2, 3: first person's body and legs, ... |
    | `prev_from_curr` | [4, 4] | float32 | current camera to previous camera |
    | `instance_motion` | [1 + 3·P, 4, 4] | float32 | the same by instance; row 0: static world |
    | `rgb` | [3, k·H, k·W] | uint8 | colours, k = `picture_scale` |
    | `frame` | [2] | int64 | identifies the frame: the episode's seed, the steps since its start |

    At reset the previous pose is the current one. `info` holds `outcome`, `hit` (the category that
    the vehicle hit, or ""), `episode_seed` and `path`.

    Args:
        scene: a scene's name, file, mapping, or `Scene`.
        speed: the pedestrians' speed mode, or their (lowest, highest) speed in m/s.
        frame_rate_hz: steps a second; None for the scene's. The time limit stays the same in
            seconds.
        sensors: the keys of the observation; without any, nothing is rendered.
        render_mode: "rgb_array" or None.
        picture_scale: size of `rgb` and of rendered pictures, as a multiple of the maps'. Flow
            estimated from larger pictures and averaged is more accurate.

    Raises:
        SceneError: the scene is invalid.
        ValueError: another argument is invalid.
    """

    sensing: Sensing
    _street: Street
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 12}  # noqa: RUF012

    def __init__(
        self,
        scene: str | Path | Mapping[str, Any] | Scene = "straight_road",
        speed: SpeedMode | Range = "normal",
        frame_rate_hz: float | None = None,
        sensors: Sequence[str] = SENSORS[:5],
        render_mode: str | None = None,
        picture_scale: int = 1,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode is {render_mode!r}; give 'rgb_array' or None. A window opens with "
                "gymnasium.wrappers.HumanRendering around an env of 'rgb_array'"
            )
        self.scene = load_scene(scene)
        self.speed_mps = _speed_range(self.scene, speed)
        self.frame_rate_hz = checked_frame_rate(self.scene, frame_rate_hz)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.frame_rate_hz}
        self.num_classes = num_classes(self.scene.categories)
        ticks_for(self.scene, self.frame_rate_hz, self.speed_mps, 0.0)
        self._camera = sensors, picture_scale
        self._episode: Episode | None = None
        self._open()
        self.K = self.sensing.K
        self.action_space = spaces.Discrete(len(YAW_SIGN))
        self.observation_space = self.sensing.space()

    @property
    def episode(self) -> Episode:
        """The current episode, which knows every pose, for privileged policies."""
        if self._episode is None:
            raise RuntimeError("there is no episode yet: call reset() first")
        return self._episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: seeds the generator that draws the episodes' seeds.
            options: `episode_seed` (int) selects the episode and `path` (str) its path;
                `vehicle_speed_mps` (float) replaces the scene's speed, 0 for a still camera;
                `speed` and `frame_rate_hz` replace the env's for this episode. `state`, from
                `get_state`, resumes an episode and excludes the others.
        """
        self.begin(seed=seed, options=options)
        return self.sensing.observe(self.episode), self._info()

    # `begin` and `drive` return no observation, because `StreetVectorEnv` draws all of them at
    # once.

    def begin(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Begins an episode like `reset`, without an observation."""
        super().reset(seed=seed)
        if self._street is None:  # closed
            self._open()
        options = options or {}
        if "state" in options:
            if others := sorted(options.keys() - {"state"}):
                raise ValueError(f"reset options {others} can't be combined with state")
            self._resume(options["state"])
        else:
            self._begin({"episode_seed": int(self.np_random.integers(1 << 31))} | options)

    def step(self, action: int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drives one step; every end of an episode is `terminated`, also a time-out."""
        earned, is_end = self.drive(action)
        return self.sensing.observe(self.episode), earned, is_end, False, self._info()

    def drive(self, action: int) -> tuple[float, bool]:
        """Drives one step like `step`, and returns the reward and whether the episode ends."""
        episode = self._opened()
        if action not in range(len(YAW_SIGN)):
            raise ValueError(
                f"action is {action!r}; give 0 (keep the yaw rate), 1 (turn left) or 2 (turn right)"
            )
        if ended := episode.outcome:
            raise RuntimeError(f"the episode has ended ({ended.label}): call reset() first")
        episode.step(int(action), self._street)
        return reward(episode.outcome), episode.outcome != Outcome.RUNNING

    def render(self) -> Any:
        """Returns the camera's picture, [H, W, 3] uint8, if the render mode is "rgb_array"."""
        episode = self._opened()
        return None if self.render_mode is None else self.sensing.rgb(episode)

    def close(self) -> None:
        """Releases the street, whose simulator closes with the last env that uses it.

        `reset` opens it again; until then only the state of the episode remains.
        """
        self.sensing = self._street = None  # type: ignore[assignment]

    def _opened(self) -> Episode:
        if self._street is None:
            raise RuntimeError("the env is closed: call reset() first")
        return self.episode

    def _open(self) -> None:
        self._street = Street.shared(self.scene)
        self.sensing = Sensing.shared(self._street, *self._camera)

    def get_state(self) -> dict[str, Any]:
        """Returns the complete state as JSON-serialisable data."""
        episode = self.episode
        return self._info() | {
            "np_random": self.np_random.bit_generator.state,
            "vehicle_speed_mps": episode.vehicle_speed_mps,
            "speed": list(episode.speed_mps),
            "frame_rate_hz": episode.frame_rate_hz,
            "steps": episode.steps,
            "now": _data_of(episode.now),
            "before": _data_of(episode.before),
        }

    def _resume(self, state: Mapping[str, Any]) -> None:
        try:
            self._begin({name: state[name] for name in _OPTIONS})
            episode, both = self.episode, (state["before"], state["now"])
            episode.resume(*(Moment(VehicleState(*m["vehicle"]), m["ticks"]) for m in both))
            episode.steps, episode.hit = state["steps"], state["hit"]
            episode.outcome = Outcome[state["outcome"].upper()]
            self.np_random.bit_generator.state = state["np_random"]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"this is not a state returned by get_state: {error!r}") from error

    def _begin(self, options: Mapping[str, Any]) -> None:
        if unknown := sorted(options.keys() - set(_OPTIONS)):
            raise ValueError(f"unknown reset options {unknown}; they are: {', '.join(_OPTIONS)}")
        vehicle_speed_mps = options.get("vehicle_speed_mps")
        if vehicle_speed_mps is None:
            vehicle_speed_mps = self.scene.vehicle.speed_mps
        if not 0 <= _number(vehicle_speed_mps) < math.inf:
            raise ValueError(f"vehicle_speed_mps is {vehicle_speed_mps!r}; give m/s, 0 for rest")
        episode_seed = options["episode_seed"]
        if not hasattr(episode_seed, "__index__") or not 0 <= episode_seed < EPISODE_SEEDS:
            raise ValueError(f"episode_seed is {episode_seed!r}; give an int, 0 to 2**62 - 1")
        self._episode = Episode(
            self._street.layout,
            checked_frame_rate(self.scene, options.get("frame_rate_hz", self.frame_rate_hz)),
            int(episode_seed),
            _speed_range(self.scene, options.get("speed", self.speed_mps)),
            float(vehicle_speed_mps),
            options.get("path"),
        )

    def _info(self) -> dict[str, Any]:
        episode = self.episode
        return {
            "outcome": episode.outcome.label,
            "hit": episode.hit,
            "episode_seed": episode.seed,
            "path": episode.path.name,
        }


def _speed_range(scene: Scene, speed: SpeedMode | Range) -> Range:
    if isinstance(speed, str):
        if speed not in scene.pedestrian_speed_mps:
            modes = ", ".join(scene.pedestrian_speed_mps)
            raise ValueError(f"unknown speed {speed!r}; choose one of {modes}, or give (low, high)")
        return scene.pedestrian_speed_mps[speed]
    try:
        low, high = map(_number, speed)
    except (TypeError, ValueError):  # not two values
        low = high = math.nan
    if not 0 <= low <= high < math.inf:
        raise ValueError(f"speed is {speed!r}; give (lowest, highest) in m/s, or a mode's name")
    return low, high


def checked_frame_rate(scene: Scene, frame_rate_hz: float | None) -> float:
    """Returns a frame rate in 1/s, the scene's for None; ValueError if it is out of range."""
    rate = _number(scene.frame_rate_hz if frame_rate_hz is None else frame_rate_hz)
    lowest, highest = FRAME_RATES_HZ
    if not lowest <= rate <= highest:
        given = f"frame_rate_hz is {frame_rate_hz!r}"
        raise ValueError(f"{given}; give a rate from {lowest:g} to {highest:g}")
    return rate


def _number(value: Any) -> float:
    """Returns a number as a float, nan for anything else; a number in quotes is a mistake."""
    # Not from geometry.checks, since workers step envs without PyTorch.
    try:
        return math.nan if isinstance(value, str) else float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _data_of(moment: Moment) -> dict[str, Any]:
    return {"vehicle": [float(value) for value in moment.vehicle], "ticks": moment.ticks}
