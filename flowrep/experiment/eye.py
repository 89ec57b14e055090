"""One agent's representations of a pool of environments, computed from their sensors."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from flowrep.envs.torchrl_env import sensors_read
from flowrep.palette import num_classes
from flowrep.scenes.scene import Scene
from flowrep.simulator.camera import sampled_intrinsics
from flowrep.transforms import representation_stack
from flowrep.transforms.base import RecurrentTransform


class Eye:
    """An agent's representations of every environment, kept between steps if they need it.

    Args:
        scene: the scene, which gives the camera and the classes.
        representations: names, or a mapping from name to options.
        frame_rate_hz: steps per second.
        flow: the source of raw and obj, see `representation_stack`.
        noise: errors of depth and motion, see there.
        device: where they are computed.
    """

    def __init__(
        self,
        scene: Scene,
        representations: Sequence[str] | Mapping[str, Any],
        frame_rate_hz: float,
        *,
        flow: str | Mapping[str, Any] = "exact",
        noise: Mapping[str, float] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        camera = scene.camera
        focal, size = camera.focal_px, (camera.height_px, camera.width_px)
        self._transforms = representation_stack(
            representations,
            intrinsics=torch.from_numpy(sampled_intrinsics(focal, focal, *size)),
            num_classes=num_classes(scene.categories),
            dt_s=1.0 / frame_rate_hz,
            flow=flow,
            noise=noise,
        )
        self._device = torch.device(device)
        self._transforms.to(self._device)
        self.sensors = sensors_read(self._transforms)
        # what the next step needs of this one
        self._kept = [
            key
            for transform in self._transforms.transforms
            if isinstance(transform, RecurrentTransform)
            for key in transform.carried_keys
        ]
        self._latest: TensorDictBase | None = None  # [num_envs]

    def look(
        self, seen: Mapping[str, NDArray[Any]], begun: Sequence[int], going_on: Sequence[int]
    ) -> TensorDictBase:
        """Returns the maps of the environments `[*begun, *going_on]`, all computed together.

        Args:
            seen: the sensor maps of all environments, `[num_envs, ...]` by sensor.
            begun: environments whose episode has just begun.
            going_on: environments whose previous step was passed to `look` as well.
        """
        rows = [*begun, *going_on]
        sensor = {name: torch.from_numpy(seen[name][rows]) for name in self.sensors}
        now: TensorDictBase = TensorDict({"sensor": sensor}, [len(rows)]).to(self._device)
        if going_on:
            before = now.empty() if self._latest is None else self._latest[rows]
            begins = torch.arange(len(rows), device=self._device) < len(begun)
            for transform in self._transforms.transforms:
                now = transform._step(before, now)
                if isinstance(transform, RecurrentTransform):
                    now = transform.begin_anew(begins, now)
        else:
            now = self._transforms._reset(now.empty(), now)
        if self._kept:
            latest = now.select(*self._kept)
            if self._latest is None:
                num_envs = len(next(iter(seen.values())))
                self._latest = latest[:1].expand(num_envs).clone()
            self._latest[rows] = latest
        return now.exclude("sensor")
