"""TorchRL envs of streets, with the transforms that write representations."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, GymWrapper, TransformedEnv

from flowrep.config.options import SpeedMode
from flowrep.envs.sensing import SENSORS
from flowrep.envs.street_env import StreetEnv, checked_frame_rate
from flowrep.envs.vector_env import StreetVectorEnv
from flowrep.envs.workers import WorkerVectorEnv, available_cores
from flowrep.geometry.checks import checked_count
from flowrep.scenes.load import load_scene
from flowrep.scenes.scene import Range, Scene, num_classes
from flowrep.scenes.vehicle import YAW_SIGN
from flowrep.transforms import Mirror, representation_stack
from flowrep.transforms.base import as_keys
from flowrep.transforms.representations import FLOWS, DropKeys, Representations


def usable_device(device: str | torch.device) -> torch.device:
    """Returns a device on which tensors can be created; "auto" is CUDA's if there is one.

    Raises:
        ValueError: there is no such device, or this PyTorch can't use it.
    """
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, TypeError, AssertionError) as error:  # the last: built without CUDA
        reason = str(error).splitlines()[0]
        raise ValueError(f"device={device} can't be used: {reason}. Try device=cpu") from None


def sensors_read(transforms: Iterable[Any]) -> list[str]:
    """Returns the sensors that transforms read."""
    keys = {key for transform in transforms for key in transform.in_keys}
    return [name for name in SENSORS if ("sensor", name) in keys]


class VectorWrapper(GymWrapper):
    """TorchRL's wrapper of streets; reset masks are optional, and moved to the CPU."""

    scene: Scene
    frame_rate_hz: float

    def _replace_reset(self, reset: Tensor | None, kwargs: dict[str, Any]) -> dict[str, Any]:
        # TorchRL 0.14 passes masks on from the TensorDict's device, which fails on CUDA, and
        # requires them in every TensorDict; here, all envs are reset if they are missing.
        if reset is None:
            return kwargs
        mask = {"reset_mask": reset.view(self.batch_size).cpu().numpy()}
        return kwargs | {"options": {**(kwargs.get("options") or {}), **mask}}


def make_env(
    scene: str | Path | Mapping[str, Any] | Scene = "straight_road",
    representations: Representations = (),
    *,
    num_envs: int = 1,
    num_workers: int = 0,
    device: str | torch.device = "cpu",
    speed: SpeedMode | Range = "normal",
    frame_rate_hz: float | None = None,
    seed: int | None = None,
    keep_sensor: bool = False,
    flow: str | Mapping[str, Any] = "exact",
    motion: str = "exact",
    noise: Mapping[str, float] | None = None,
    compiled: bool = False,
    picture_scale: int = 1,
) -> TransformedEnv:
    """Returns a batched TorchRL env, always of batch size [num_envs].

    It reads `action` (categorical: 0 keep the yaw rate, 1 turn left, 2 turn right) and writes the
    representations, `outcome` and `hit` uint8 [1], `episode_seed` and `path` int64 [1], `vehicle`
    float32 [3] (see `StreetVectorEnv`), `reward` [1] and the done keys. The episodes of an env and
    their order depend only on its seed, not on the policy.

    Args:
        scene: a scene's name, YAML file, mapping, or `Scene`.
        representations: names, or a mapping from name to options or transform, see
            `flowrep.transforms.representation_stack`. Only the sensors that they need are rendered,
            none for an empty list.
        num_envs: the batch size.
        num_workers: number of processes that step the envs, see `WorkerVectorEnv`; 0 steps them in
            this process. The results are the same.
        device: of the TensorDicts, "auto" for CUDA's if there is one; streets run on the CPU.
        speed: see `StreetEnv`, as for `frame_rate_hz` and `picture_scale`.
        seed: the seed from which the envs draw their episodes; with None, call `set_seed`.
        keep_sensor: whether to keep the ("sensor", ...) keys; rgb and frame are kept only if a
            representation needs them.
        flow: "exact" or "estimated", the source of raw and obj; a mapping gives options, see
            `flowrep.transforms.representation_stack`.
        motion: the source of the camera's motion for ego and obj: "exact", or "estimated" from flow
            and depth.
        noise: errors of a depth camera and of odometry, see `representation_stack`; a repeated
            episode has the same noise.
        compiled: whether flow is computed by `torch.compile`, equal up to rounding, after up to a
            minute of compilation. On a CPU, numba, which computes it otherwise, is faster.

    Raises:
        SceneError: the scene is invalid.
        ValueError: an argument is invalid, the device can't be used, or there is no C++ compiler
            for `compiled=True`.

    >>> env = make_env("straight_road", ["ego", "obj"], num_envs=2, seed=0)
    >>> env.rollout(3)["next", "obj"].shape
    torch.Size([2, 3, 2, 84, 84])
    >>> env.close()
    """
    num_envs = checked_count("num_envs", num_envs)
    num_workers = checked_count("num_workers", num_workers, least=0)
    seed = None if seed is None else checked_count("seed", seed, least=0)
    device = usable_device(device)
    loaded = load_scene(scene)
    # An estimator and its pictures need one scale; that of a mapping counts.
    if flow == "estimated":
        flow = {"source": flow}
    if isinstance(flow, Mapping) and flow.get("source") == "estimated":
        flow = {"picture_scale": picture_scale, **flow}
        picture_scale = flow["picture_scale"]
    street = partial(StreetEnv, loaded, speed, frame_rate_hz, picture_scale=picture_scale)
    transforms, rate_hz = Compose(), checked_frame_rate(loaded, frame_rate_hz)
    if representations:
        transforms = representation_stack(
            representations,
            intrinsics=torch.from_numpy(loaded.camera.K),
            num_classes=num_classes(loaded.categories),
            compiled=compiled,
            flow=flow,
            motion=motion,
            noise=noise,
            frame_rate_hz=rate_hz,
        )
    sensors = sensors_read(transforms)
    if keep_sensor:  # rgb and frame only if a transform reads them
        sensors = [name for name in SENSORS if name in sensors or name not in ("rgb", "frame")]
    elif sensors:
        transforms.append(DropKeys("sensor"))
    factories = [partial(street, sensors=sensors)] * num_envs
    base = VectorWrapper(
        WorkerVectorEnv(factories, num_workers, in_each=StreetVectorEnv)
        if num_workers
        else StreetVectorEnv(factories),
        device=device,
        categorical_action_encoding=True,
    )
    base.scene, base.frame_rate_hz = loaded, rate_hz
    env = TransformedEnv(base, transforms)
    if seed is not None:
        env.set_seed(seed)
    return env


def make_mirror(
    scene: str | Path | Mapping[str, Any] | Scene, representations: str | Iterable[str]
) -> Mirror:
    """Returns the transform that replaces half of a replay batch by mirror images.

    Args:
        scene: as for `make_env`; its camera determines which columns mirror each other.
        representations: the key of a map, or several keys, as in `make_env`.

    >>> make_mirror("straight_road", ["ego", "seg2"]).swapped_actions
    tensor([0, 2, 1])
    """
    names, K = as_keys(representations), load_scene(scene).camera.K
    flows = [name for name in names if name in FLOWS]
    swapped = [YAW_SIGN.index(-sign) for sign in YAW_SIGN]
    return Mirror(names, flow_keys=flows, swapped_actions=swapped, intrinsics=K.tolist())


def begin_step(env: TransformedEnv, acted: TensorDictBase) -> None:
    """Starts `env.step(acted)` in the env's workers; does nothing without workers."""
    vector = _vector(env)
    if vector.num_workers:
        vector.step_async(env.base_env.read_action(acted[env.action_key]))


def has_spare_cores(env: TransformedEnv, threads: int) -> bool:
    """Returns whether there is a core for each worker of the env and each of `threads` threads."""
    # If not, running both at once takes longer than one after the other: threads synchronise at
    # every operation, and all of them wait when one loses its core.
    return _vector(env).num_workers + threads <= available_cores()


def street_envs(env: TransformedEnv) -> list[StreetEnv]:
    """Returns the `StreetEnv`s of an env made by `make_env`, in the order of its batch.

    Raises:
        ValueError: the envs are in worker processes.
    """
    vector = _vector(env)
    if vector.num_workers:
        raise ValueError("the envs are in worker processes: give num_workers=0")
    return [street.unwrapped for street in vector.envs]


def get_states(env: TransformedEnv) -> list[dict[str, Any]]:
    """Returns the state of every env as JSON-serialisable data."""
    return list(_vector(env).call("get_state"))


def set_states(env: TransformedEnv, states: Sequence[Mapping[str, Any]]) -> None:
    """Restores states from `get_states`; continue with the TensorDict of the same step.

    Raises:
        ValueError: there isn't one state for each env.
    """
    vector = _vector(env)
    if len(states) != (count := vector.num_envs):
        raise ValueError(f"{len(states)} states for {count} envs; give one for each")
    env.reset()
    vector.reset(options={"episodes": [{"state": state} for state in states]})


def _vector(env: TransformedEnv) -> Any:
    return env.base_env._env
