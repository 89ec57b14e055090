"""Builds what a config describes: env, agent, policy. Modules below see no config."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from multiprocessing import current_process
from pkgutil import resolve_name
from typing import Any

import torch
from pydantic import create_model
from torchrl.envs import EnvBase, InitTracker, Transform

from flowrep.agent import Algorithm
from flowrep.agent.networks import PolicyNetwork
from flowrep.agent.precision import resolved_precision
from flowrep.config.algorithms import ALGORITHMS, AlgorithmOptions
from flowrep.config.options import FlowOptions, validated
from flowrep.config.usage import UsageError
from flowrep.envs import make_env, make_mirror
from flowrep.envs.torchrl_env import usable_device
from flowrep.envs.workers import available_cores, sheltered
from flowrep.experiment.schema import EnvConfig, TrainConfig
from flowrep.transforms import representation_stack

ENVS_PER_WORKER = 24  # in an evaluation: fewer aren't worth starting a process


def env(config: EnvConfig, **changes: Any) -> EnvBase:
    """Returns the env that the config describes; `changes` replace arguments of `make_env`.

    Without `num_workers`, which differs between training and evaluation, it has none. Observations
    include `is_init`, by which the replay memory sees that an episode begins.
    """
    arguments: dict[str, Any] = {
        "scene": config.scene,
        "representations": config.representations,
        "flow": dict(config.flow),
        "motion": config.motion,
        "noise": config.noise,
        "num_envs": config.num_envs,
        "device": config.device,
        "speed": config.speed,
    }
    arguments |= changes
    maps = arguments["representations"]
    arguments["representations"] = {name: _described(name, maps[name]) for name in maps}
    return make_env(**arguments).append_transform(InitTracker())


def training(config: TrainConfig) -> tuple[EnvBase, Algorithm]:
    """Returns the env and the untrained agent of a config that `resolved` returned."""
    device = usable_device(config.device)
    share_cores(device, config.flow)
    torch.manual_seed(config.seed)
    workers = training_workers(config, device)
    streets = env(config, num_workers=workers, compiled=config.compiled)
    # Env i draws its episodes from seed · num_envs + i: runs of two seeds share none.
    streets.set_seed(config.seed * config.num_envs)
    # TorchRL's storage starts multiprocessing's resource tracker, which a SIGHUP would end.
    with sheltered():
        return streets, agent(config, streets)


def agent(config: TrainConfig, env: EnvBase) -> Algorithm:
    """Returns the config's algorithm, untrained, for the env's specs and on its device."""
    maker, specs, options, run = _task(config, env)
    if getattr(options, "mirror", False):
        run["mirror_image"] = make_mirror(config.scene, config.representations)
    return maker(*specs, options, **run)


def policy(config: TrainConfig, env: EnvBase) -> Any:
    """Returns the config's policy, untrained, without the rest of the agent."""
    maker, specs, options, run = _task(config, env)
    return maker.make_policy(*specs, options, **run)


def evaluated(config: TrainConfig, env: EnvBase, trained: Any) -> Any:
    """Returns a trained policy as it is evaluated, see `evaluation.mirror`, with its weights."""
    if not (config.evaluation.mirror and config.scene.symmetric):
        return trained
    acting = policy(config, env)
    acting.load_state_dict(trained.state_dict(), assign=True)  # not a copy
    networks = [each for each in acting.modules() if isinstance(each, PolicyNetwork)]
    if not networks:
        raise UsageError("evaluation.mirror=true: the algorithm's policy has no PolicyNetwork")
    networks[0].mirror = make_mirror(config.scene, config.representations).to(env.device)
    return acting


def _task(config: TrainConfig, env: EnvBase) -> tuple[Any, tuple[Any, ...], Any, dict[str, Any]]:
    maker, options = algorithm(config.algorithm)
    specs = env.observation_spec, env.action_spec, list(config.representations)
    return maker, specs, options, {"total_frames": config.total_frames, "device": env.device}


def algorithm(section: AlgorithmOptions) -> tuple[Any, Any]:
    """Returns the class that a section names, and its options; checks those of a user's class."""
    maker = _class("algorithm", section.target, Algorithm)
    if section.target in ALGORITHMS:
        return maker, section
    whole: Any = create_model("Config", algorithm=(maker.OPTIONS, ...))
    return maker, validated(whole, {"algorithm": section.plain()}).algorithm


def resolved(config: TrainConfig) -> TrainConfig:
    """Returns a config that names the number format in which this machine computes.

    A run stores it and keeps that format on any machine; its device and workers may stay "auto".
    Before, what needs PyTorch is checked: device and threads, the classes that are named, and all
    options that the algorithm and the transforms of maps, flow and noise take.
    """
    device = usable_device(config.device)
    if config.threads > (cores := available_cores()):
        raise UsageError(f"threads={config.threads} on {cores} cores: give {cores} or fewer")
    algorithm(config.algorithm)[1].first_update(config.num_envs)
    try:
        representation_stack(
            {name: _described(name, given) for name, given in config.representations.items()},
            intrinsics=[[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]],  # any camera's
            num_classes=2,
            flow=dict(config.flow),
            motion=config.motion,
            noise=config.noise,
            frame_rate_hz=config.scene.frame_rate_hz,
        )
    except ValueError as error:
        raise UsageError(f"representations, flow or noise: {error}") from error
    return with_precision(config, device)


def _described(name: str, options: Mapping[str, Any] | None) -> Any:
    """Returns a representation's options, or the user's class with them, checked."""
    if not options or "_target_" not in options:
        return options
    arguments = dict(options)
    maker = _class(f"representations.{name}", arguments.pop("_target_"), Transform)
    described = partial(maker, **arguments)
    try:  # with any camera: `representation_stack` calls it with the scene's
        representation_stack({name: described}, intrinsics=torch.eye(3), num_classes=1)
    except (TypeError, ValueError) as error:
        raise UsageError(f"representations.{name}: {error}") from error
    return described


def _class(key: str, target: str, base: type) -> Any:
    """Returns the class that a config names; raises UsageError unless it is a `base`."""
    try:
        named = resolve_name(target)
    except (ImportError, AttributeError, ValueError) as error:
        raise UsageError(
            f"{key}._target_={target} can't be imported: {error}; is its folder in PYTHONPATH?"
        ) from None
    if not (isinstance(named, type) and issubclass(named, base)):
        raise UsageError(
            f"{key}._target_={target} is not a subclass of {base.__module__}.{base.__name__}"
        )
    return named


def with_precision(
    config: TrainConfig, device: torch.device, precision: str | None = None
) -> TrainConfig:
    """Returns a config with this precision, or its own; "auto" is replaced by the device's."""
    section = config.algorithm
    _, options = algorithm(section)
    if not hasattr(options, "precision"):  # of a user's algorithm
        return config
    name = options.precision if precision is None else precision
    chosen = {"precision": resolved_precision(name, device)}
    return config.model_copy(update={"algorithm": section.model_copy(update=chosen)})


def share_cores(device: torch.device, flow: FlowOptions) -> None:
    """Limits this process to one thread on a CPU, except for updates and estimated flow.

    Nothing else is large enough to gain from a second thread. If another program is busy, threads
    that wait for each other make a step take up to a hundred times as long.
    """
    if device.type == "cpu" and flow.source == "exact":
        torch.set_num_threads(1)


def training_workers(config: TrainConfig, device: torch.device) -> int:
    """Returns the number of processes that step a training's envs."""
    if config.num_workers != "auto":
        return config.num_workers
    # On a CPU, updates need cores of their own.
    return _worker_count(config.num_envs, config.threads if device.type == "cpu" else 0)


def evaluation_workers(config: EnvConfig, num_envs: int) -> int:
    """Returns the number of processes that step an evaluation's environments."""
    if config.num_workers != "auto":
        return min(config.num_workers, num_envs)
    return _worker_count(num_envs // ENVS_PER_WORKER)


def _worker_count(num_envs: int, busy_cores: int = 0) -> int:
    """Returns the number of worker processes: one for each core that isn't busy."""
    # In a pool of processes, as with hydra/launcher=joblib, the others use the other cores.
    cores, is_in_pool = available_cores(), current_process().name != "MainProcess"
    if is_in_pool or min(cores, num_envs) < 2:
        return 0
    return min(max(cores - busy_cores, 0), num_envs)
