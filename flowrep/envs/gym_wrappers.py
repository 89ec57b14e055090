"""Representations as numpy maps, for gymnasium users without TorchRL."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from flowrep.envs.street_env import Outcome, StreetEnv
from flowrep.envs.torchrl_env import sensors_read
from flowrep.envs.vector_env import StreetVectorEnv
from flowrep.scenes.scene import Scene
from flowrep.transforms import representation_stack
from flowrep.transforms.flow import Intrinsics
from flowrep.transforms.representations import Representations

_NEXT_STEP = gym.vector.AutoresetMode.NEXT_STEP
Maps = NDArray[Any] | dict[str, NDArray[Any]]


class RepresentationObservation(gym.Wrapper):
    """Replaces the sensor maps of an env by representations, channels first and finite.

    If joined, the observation is one `Box` `[C, H, W]`: float32, with the representations' channels
    in the given order, ids one-hot and colours divided by 255; rgb alone stays uint8. If not
    joined, it is a `Dict` of maps by name, as in `make_env`.

    Args:
        env: its observation is a dict of sensor maps and motions, as `StreetEnv`'s.
        representations: see `flowrep.transforms.representation_stack`.
        intrinsics: K `[3, 3]` of the maps; the env's `K` by default.
        num_classes: the number of semantic classes; the env's `num_classes` by default.

    Raises:
        ValueError: the observation is not a dict, or a representation needs something that neither
            the env nor an argument gives; at a reset, the env's `K` has changed.

    >>> env = gym.make("flowrep/StraightRoad-v0", representations=["ego", "obj"])
    >>> observation, info = env.reset(seed=0)
    >>> observation.shape, observation.dtype
    ((4, 84, 84), dtype('float32'))
    >>> env.close()
    """

    def __init__(
        self,
        env: gym.Env,
        representations: Representations,
        *,
        joined: bool = True,
        intrinsics: Intrinsics | None = None,
        num_classes: int | None = None,
    ) -> None:
        super().__init__(env)
        self.names = tuple(representations)
        self.joined = joined
        inner = env.unwrapped
        self._K = np.array(inner.K) if intrinsics is None and hasattr(inner, "K") else None
        if self._K is not None:
            intrinsics = torch.from_numpy(self._K)
        if num_classes is None:
            num_classes = getattr(inner, "num_classes", None)
        is_list = not isinstance(representations, str)  # which the stack refuses by its whole name
        asked = _onehot(representations) if joined and is_list else representations
        self._stack = representation_stack(
            asked,
            intrinsics=intrinsics,
            num_classes=num_classes,
            frame_rate_hz=getattr(inner, "frame_rate_hz", None),
        )
        self._now = TensorDict()
        self.observation_space = self._space(env.observation_space)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Maps, dict[str, Any]]:
        """Begins an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        K: Any = getattr(self.unwrapped, "K", None)
        if self._K is not None and not np.array_equal(K, self._K):
            raise ValueError(
                f"the env's K was {self._K.tolist()} and is now {K.tolist()}: let the env observe "
                "it, and give its key as intrinsics="
            )
        # These are the methods of a transform that TorchRL's TransformedEnv calls.
        sensed = _sensed(observation)
        self._now = self._stack._reset(sensed, sensed)
        return self._arrays(self._now), info

    def step(self, action: Any) -> tuple[Maps, float, bool, bool, dict[str, Any]]:
        """Takes a step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._now = self._stack._step(self._now, _sensed(observation))
        return self._arrays(self._now), float(reward), terminated, truncated, info

    def _arrays(self, tensordict: TensorDictBase) -> Maps:
        maps = {name: tensordict[name].numpy() for name in self.names}
        # Copies, as the next step reads the stacks, and colours are the env's own array.
        return _joined(maps.values()) if self.joined else {n: m.copy() for n, m in maps.items()}

    def _space(self, sensors: spaces.Space) -> spaces.Space:
        if not isinstance(sensors, spaces.Dict):
            raise ValueError(f"representations need a dict of sensor maps, got {sensors}")
        spec = Composite(sensor=Composite({key: _spec(box) for key, box in sensors.items()}))
        spec = self._stack.transform_observation_spec(spec)
        boxes = {name: _box(spec[name]) for name in self.names}
        if not self.joined:
            return spaces.Dict(dict[str, spaces.Space](boxes))
        low, high = map(_joined, zip(*((box.low, box.high) for box in boxes.values())))
        return spaces.Box(low, high, dtype=low.dtype)


class RepresentationVectorObservation(gym.vector.VectorWrapper):
    """Streets side by side with the maps and infos of `make_street`, computed for all at once.

    Args:
        env: observes `sensor` and the status of each street, as `StreetVectorEnv`.
        representations: see `RepresentationObservation`, as for `joined`.
        truncate_timeouts: see `NumericInfo`.
    """

    def __init__(
        self,
        env: StreetVectorEnv,
        representations: Representations,
        *,
        joined: bool = True,
        truncate_timeouts: bool = False,
    ) -> None:
        super().__init__(env)
        self._one = RepresentationObservation(env.envs[0], representations, joined=joined)
        self.single_observation_space = self._one.observation_space
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self.autoreset_mode = env.autoreset_mode  # TorchRL's GymWrapper reads it
        self._truncate_timeouts = truncate_timeouts
        self._ended = np.zeros(env.num_envs, dtype=bool)
        self._now = TensorDict()

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Maps, dict[str, Any]]:
        """Begins episodes, see `StreetVectorEnv.reset`."""
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs))
        begun = np.asarray(mask, dtype=bool)  # numbers would be indices
        observation, _ = self.env.reset(seed=seed, options=options)
        self._ended = self._ended & ~begun
        return self._maps(observation["sensor"], begun, self._now.clone()), _numbers(observation)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[Maps, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Takes a step; the step after an episode's last one begins the next episode."""
        observation, rewards, ended, truncated, _ = self.env.step(actions)
        maps = self._maps(observation["sensor"], self._ended)
        self._ended = ended
        if self._truncate_timeouts:
            truncated = ended & (observation["outcome"][:, 0] == Outcome.TIMEOUT)
        return maps, rewards, ended & ~truncated, truncated, _numbers(observation)

    def _maps(
        self,
        sensors: Mapping[str, NDArray[Any]],
        begun: NDArray[np.bool_],
        others: TensorDictBase | None = None,
    ) -> Maps:
        """Returns the maps of streets that have begun an episode, and of others after a step."""
        sensed, rows = _sensed(sensors, [self.num_envs]), torch.as_tensor(begun)
        if rows.all() or self._now.is_empty():  # without an episode, sensors are 0
            self._now = self._one._stack._reset(sensed, sensed)
        else:
            self._now = self._one._stack._step(self._now, sensed) if others is None else others
            if rows.any():
                first = sensed[rows]
                self._now[rows] = self._one._stack._reset(first, first)
        return self._one._arrays(self._now)


def _numbers(observation: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Returns what `NumericInfo` has of each street, with the masks that gymnasium wants."""
    names = ("outcome", "hit", "episode_seed", "path")
    infos = {name: observation[name][:, 0].astype(np.int64) for name in names}
    infos["is_success"] = infos["outcome"] == Outcome.SUCCESS
    return infos | {f"_{name}": np.ones(len(infos["path"]), dtype=bool) for name in infos}


class NumericInfo(gym.Wrapper):
    """Replaces `info` by numbers, and optionally reports time-outs as truncations.

    `outcome` is a code of `Outcome`, `hit` a class id or 255, `path` an index into the scene's
    paths; `is_success` is for Stable-Baselines3.

    Args:
        env: a `StreetEnv`, wrapped or not.
        truncate_timeouts: whether a time-out is `truncated` instead of `terminated`.
    """

    def __init__(self, env: gym.Env, *, truncate_timeouts: bool = False) -> None:
        super().__init__(env)
        self.truncate_timeouts = truncate_timeouts

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode."""
        observation, _ = self.env.reset(seed=seed, options=options)
        return observation, self._numbers()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Drives one step; a time-out is `truncated` or, by default, `terminated`."""
        observation, reward, terminated, truncated, _ = self.env.step(action)
        numbers = self._numbers()
        if self.truncate_timeouts and numbers["outcome"] == Outcome.TIMEOUT:
            terminated, truncated = False, True
        return observation, float(reward), terminated, truncated, numbers

    def _numbers(self) -> dict[str, Any]:
        episode = cast(StreetEnv, self.unwrapped).episode
        return episode.status() | {"is_success": episode.outcome == Outcome.SUCCESS}


def make_street(
    scene: str | Path | Mapping[str, Any] | Scene = "straight_road",
    representations: Representations = (),
    *,
    joined: bool = True,
    truncate_timeouts: bool = False,
    **options: Any,
) -> gym.Env:
    """Returns a `StreetEnv` for `gymnasium.make`, wrapped if representations are given.

    Args:
        representations: as for `RepresentationObservation`; without any, observations are the
            `StreetEnv`'s. With some, or with `truncate_timeouts`, `info` holds numbers, see
            `NumericInfo`.
        joined: see `RepresentationObservation`.
        truncate_timeouts: see `NumericInfo`.
        options: further arguments of `StreetEnv`.
    """
    if representations:
        options = {"sensors": _read_by(representations), **options}
    env: gym.Env = StreetEnv(scene, **options)
    if representations or truncate_timeouts:
        env = NumericInfo(env, truncate_timeouts=truncate_timeouts)
    if representations:
        env = RepresentationObservation(env, representations, joined=joined)
    return env


def make_streets(
    num_envs: int = 1,
    scene: str | Path | Mapping[str, Any] | Scene = "straight_road",
    representations: Representations = (),
    *,
    joined: bool = True,
    truncate_timeouts: bool = False,
    **options: Any,
) -> gym.vector.VectorEnv:
    """Returns streets for `gymnasium.make_vec`, as `SyncVectorEnv` of `make_street`, but faster.

    Args:
        num_envs: the number of streets; for the other arguments, see `make_street`.
    """
    if not representations:
        options |= {"truncate_timeouts": truncate_timeouts}
        return gym.vector.SyncVectorEnv([partial(make_street, scene, **options)] * num_envs)
    options = {"sensors": _read_by(representations), **options}
    streets = StreetVectorEnv([partial(StreetEnv, scene, **options)] * num_envs, _NEXT_STEP)
    return RepresentationVectorObservation(
        streets, representations, joined=joined, truncate_timeouts=truncate_timeouts
    )


def _read_by(representations: Representations) -> list[str]:
    # Arbitrary: the sensors that are read don't depend on camera, classes and frame rate.
    any_env: dict[str, Any] = {"intrinsics": torch.eye(3), "num_classes": 1, "frame_rate_hz": 1.0}
    return sensors_read(representation_stack(representations, **any_env))


def _onehot(representations: Representations) -> dict[str, Any]:
    """Returns the representations with one-hot ids, because a class id is not an intensity."""
    options: dict[str, Any] = dict.fromkeys(representations)
    if isinstance(representations, Mapping):
        options |= representations
    for name in {"seg", "seg2"} & options.keys():
        options[name] = dict(options[name] or {}) | {"encoding": "onehot"}
    return options


def _sensed(observation: Mapping[str, NDArray[Any]], batch: Sequence[int] = ()) -> TensorDict:
    tensors = {key: torch.from_numpy(np.asarray(each)) for key, each in observation.items()}
    # A nested dict takes twice as long.
    return TensorDict({"sensor": TensorDict(tensors, batch)}, batch)


def _joined(maps: Iterable[NDArray[Any]]) -> NDArray[Any]:
    """Returns maps [..., C, H, W] joined along the channels: float32, bytes divided by 255."""
    maps = list(maps)
    if any(each.dtype != np.uint8 for each in maps):
        maps = [
            m / np.float32(255) if m.dtype == np.uint8 else m.astype(np.float32, copy=False)
            for m in maps
        ]
    return np.concatenate(maps, axis=-3)


def _spec(box: Any) -> Bounded | Unbounded:
    dtype = torch.as_tensor(np.empty(0, box.dtype)).dtype
    if dtype.is_floating_point:
        return Unbounded(box.shape, dtype=dtype)
    return Bounded(torch.as_tensor(box.low), torch.as_tensor(box.high), box.shape, dtype=dtype)


def _box(spec: Bounded | Categorical | Unbounded) -> spaces.Box:
    dtype = torch.empty(0, dtype=spec.dtype).numpy().dtype
    if isinstance(spec, Categorical):
        return spaces.Box(0, spec.n - 1, tuple(spec.shape), dtype)
    if isinstance(spec, Bounded):
        return spaces.Box(spec.space.low.numpy(), spec.space.high.numpy(), dtype=dtype)
    return spaces.Box(-np.inf, np.inf, tuple(spec.shape), dtype)
