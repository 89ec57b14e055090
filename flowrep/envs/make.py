"""The street as a TorchRL environment, with the transforms that write its representations."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torchrl.data import Composite
from torchrl.envs import Compose, ExcludeTransform, GymWrapper, TransformedEnv

from flowrep.envs.loading import load_scene
from flowrep.envs.outcome import NOTHING_HIT, Outcome, hit_code
from flowrep.envs.scene import Range, Scene, SpeedMode
from flowrep.envs.sensing import SENSORS
from flowrep.envs.street_env import StreetEnv
from flowrep.transforms import representation_stack

_OUTCOME_CODE = {outcome.label: outcome.value for outcome in Outcome}


class SensorObservation(gym.Wrapper):
    """Nests the observation under "sensor" and puts beside it how the episode stands.

    | key | shape | dtype | what |
    | --- | --- | --- | --- |
    | `sensor` | | | the wrapped environment's observation |
    | `outcome` | [1] | uint8 | code of `flowrep.envs.Outcome`; 0 while the episode runs |
    | `hit` | [1] | uint8 | class id of what was hit; 255 for nothing |
    | `episode_seed` | [1] | int64 | names the episode, see `StreetEnv.reset` |
    """

    def __init__(self, env: gym.Env) -> None:
        """Wraps a `StreetEnv`."""
        super().__init__(env)
        beside: dict[str, spaces.Space] = {
            "outcome": spaces.Box(0, len(Outcome) - 1, (1,), np.uint8),
            "hit": spaces.Box(0, NOTHING_HIT, (1,), np.uint8),
            "episode_seed": spaces.Box(0, (1 << 31) - 1, (1,), np.int64),
        }
        sensor = env.observation_space
        has_sensors = isinstance(sensor, spaces.Dict) and len(sensor.spaces) > 0
        self._names = ("sensor",) if has_sensors else ()
        self.observation_space = spaces.Dict(dict.fromkeys(self._names, sensor) | beside)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self.arrange(observation, info), {}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drives one step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self.arrange(observation, info), float(reward), terminated, truncated, {}

    def arrange(self, observation: dict[str, Any], info: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the observation as this wrapper gives it."""
        return dict.fromkeys(self._names, observation) | {
            "outcome": np.array([_OUTCOME_CODE[info["outcome"]]], dtype=np.uint8),
            "hit": np.array([hit_code(info["hit"])], dtype=np.uint8),
            "episode_seed": np.array([info["episode_seed"]], dtype=np.int64),
        }


class DropSensor(ExcludeTransform):
    """Drops all ("sensor", ...) keys, once the representations have been made from them."""

    def __init__(self) -> None:
        """Excludes the whole of "sensor"."""
        super().__init__("sensor")

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Returns the specs without "sensor"."""
        del output_spec["full_observation_spec"]["sensor"]
        return output_spec


def make_env(
    scene: str | Path | Mapping[str, Any] | Scene = "straight_road",
    representations: Sequence[str] | Mapping[str, Mapping[str, Any] | None] = (),
    *,
    num_envs: int = 1,
    device: str | torch.device = "cpu",
    speed: SpeedMode | Range = "normal",
    frame_rate_hz: float | None = None,
    seed: int | None = None,
    keep_sensor: bool = False,
    flow: str | Mapping[str, Any] = "exact",
) -> TransformedEnv:
    """Returns a TorchRL env of streets stepped side by side, always of batch size [num_envs].

    Reads action (categorical: 0 NO_OP, 1 TURN_LEFT, 2 TURN_RIGHT). Writes the representations,
    `outcome` and `hit` uint8 [1], `episode_seed` int64 [1], `reward` [1] and the done keys. Env
    i's k-th episode is the same whatever the policy.

    Args:
        scene: a scene's name, file, mapping, or `Scene`.
        representations: names, or a mapping from name to options; only the sensors that they need
            are rendered, none for an empty list.
        num_envs: how many streets.
        device: where the TensorDicts lie.
        speed: the pedestrians' speed mode, or their (lowest, highest) speed in m/s.
        frame_rate_hz: steps a second; the scene's own if None.
        seed: seeds the envs, which draw their episodes from it; None leaves that to `set_seed`.
        keep_sensor: whether all ("sensor", ...) keys stay beside the representations.
        flow: "exact" or "estimated", where raw and obj come from; a mapping gives options, see
            `flowrep.transforms.representation_stack`.

    >>> env = make_env("straight_road", ["ego", "obj"], num_envs=2, seed=0)
    >>> env.rollout(3)["next", "obj"].shape
    torch.Size([2, 3, 2, 84, 84])
    >>> env.close()
    """
    loaded = load_scene(scene)
    street = partial(StreetEnv, loaded, speed=speed, frame_rate_hz=frame_rate_hz)
    # A street that renders nothing is asked for what the transforms need to know.
    probe = street(sensors=())
    transforms = Compose()
    if representations:
        transforms = representation_stack(
            representations,
            intrinsics=torch.from_numpy(probe.K),
            num_classes=probe.num_classes,
            dt_s=1.0 / probe.frame_rate_hz,
            flow=flow,
        )
    probe.close()
    sensors = _sensors_read(transforms)
    if keep_sensor:
        sensors = [name for name in SENSORS if name in sensors or name != "rgb"]
    elif sensors:
        transforms.append(DropSensor())
    vector = SyncVectorEnv(
        [lambda: SensorObservation(street(sensors=sensors))] * num_envs,
        autoreset_mode=AutoresetMode.DISABLED,
    )
    base = GymWrapper(vector, device=torch.device(device), categorical_action_encoding=True)
    env = TransformedEnv(base, transforms)
    if seed is not None:
        env.set_seed(seed)
    return env


def streets(env: TransformedEnv) -> list[StreetEnv]:
    """Returns the streets of an env that `make_env` made, in the order of its batch."""
    return [street.unwrapped for street in env.base_env._env.envs]


def get_states(env: TransformedEnv) -> list[dict[str, Any]]:
    """Returns the state of every street, plain data that JSON can hold."""
    return [street.get_state() for street in streets(env)]


def set_states(env: TransformedEnv, states: Sequence[Mapping[str, Any]]) -> None:
    """Takes every street back to a state of `get_states`; goes on from the TensorDict of then."""
    env.reset()
    for street, state in zip(streets(env), states, strict=True):
        street.set_state(state)


def _sensors_read(transforms: Iterable[Any]) -> list[str]:
    keys = {key for transform in transforms for key in transform.in_keys}
    return [name for name in SENSORS if ("sensor", name) in keys]
