"""The gymnasium env of a street."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium import spaces

from flowrep.choices import FRAME_RATES_HZ, SpeedMode
from flowrep.envs.episode import EPISODE_SEEDS, Episode, Moment, Outcome, reward
from flowrep.envs.sensing import SENSORS, Sensing
from flowrep.scenes.load import load_scene
from flowrep.scenes.scene import Range, Scene, num_classes
from flowrep.scenes.vehicle import YAW_SIGN, VehicleState
from flowrep.simulator.street import Street

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
        renderer: "rasteriser" (or "auto"), whose colours are textured, or "pybullet".
        picture_scale: size of `rgb` and of rendered pictures, as a multiple of the maps'. Flow
            estimated from larger pictures and averaged is more accurate.

    Raises:
        SceneError: the scene is invalid.
        ValueError: another argument is invalid.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 12}  # noqa: RUF012

    def __init__(
        self,
        scene: str | Path | Mapping[str, Any] | Scene = "straight_road",
        speed: SpeedMode | Range = "normal",
        frame_rate_hz: float | None = None,
        sensors: Sequence[str] = SENSORS[:5],
        render_mode: str | None = None,
        renderer: str = "auto",
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
        self._street = Street.shared(self.scene)
        self.sensing = Sensing.shared(self._street, sensors, renderer, picture_scale)
        self.K = self.sensing.K
        self._episode: Episode | None = None
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
        options = options or {}
        if "state" in options:
            if others := sorted(options.keys() - {"state"}):
                raise ValueError(f"reset options {others} can't be combined with state")
            try:
                self._resume(options["state"])
            except (KeyError, TypeError) as error:
                raise ValueError(f"this is not a state returned by get_state: {error!r}") from error
        else:
            self._begin({"episode_seed": int(self.np_random.integers(1 << 31))} | options)

    def step(self, action: int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drives one step; every end of an episode is `terminated`, also a time-out."""
        outcome = self.drive(action)
        observation = self.sensing.observe(self.episode)
        return observation, reward(outcome), outcome != Outcome.RUNNING, False, self._info()

    def drive(self, action: int) -> Outcome:
        """Drives one step like `step`, without an observation."""
        episode = self.episode
        if action not in range(len(YAW_SIGN)):
            raise ValueError(
                f"action is {action!r}; give 0 (keep the yaw rate), 1 (turn left) or 2 (turn right)"
            )
        if ended := episode.outcome:
            raise RuntimeError(f"the episode has ended ({ended.label}): call reset() first")
        episode.step(int(action), self._street)
        return episode.outcome

    def render(self) -> Any:
        """Returns the camera's picture, [H, W, 3] uint8, if the render mode is "rgb_array"."""
        return None if self.render_mode is None else self.sensing.rgb(self.episode)

    def close(self) -> None:
        """Releases the street; its simulator closes with the last env that uses it."""
        self.sensing = self._street = None  # type: ignore[assignment]

    def get_state(self) -> dict[str, Any]:
        """Returns the complete state as JSON-serialisable data."""
        episode = self.episode
        return self._info() | {
            "np_random": self.np_random.bit_generator.state,
            "vehicle_speed_mps": episode.vehicle_speed_mps,
            "speed": list(episode.speed_mps),
            "frame_rate_hz": episode.frame_rate_hz,
            "steps": episode.steps,
            "now": _plain(episode.now),
            "before": _plain(episode.before),
        }

    def _resume(self, state: Mapping[str, Any]) -> None:
        self.np_random.bit_generator.state = state["np_random"]
        self._begin({name: state[name] for name in _OPTIONS})
        episode = self.episode
        episode.steps, episode.hit = state["steps"], state["hit"]
        episode.outcome = Outcome[state["outcome"].upper()]
        both = state["before"], state["now"]
        episode.resume(*(Moment(VehicleState(*m["vehicle"]), m["ticks"]) for m in both))

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
    except (TypeError, ValueError):
        return math.nan


def _plain(moment: Moment) -> dict[str, Any]:
    return {"vehicle": [float(value) for value in moment.vehicle], "ticks": moment.ticks}
