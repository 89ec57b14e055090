"""Builds what a config describes: env, agent, policy, device. Modules below see no config."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pkgutil import resolve_name
from typing import Any

import torch
from pydantic import create_model
from torchrl.envs import EnvBase, InitTracker, Transform

from flowrep.agent import Algorithm
from flowrep.agent.precision import resolved_precision
from flowrep.config.algorithms import ALGORITHMS, AlgorithmOptions
from flowrep.config.options import validated
from flowrep.config.usage import UsageError
from flowrep.envs import make_env, make_mirror
from flowrep.envs.torchrl_env import usable_device
from flowrep.envs.workers import ENVS_PER_WORKER, available_cores, sheltered, worker_count
from flowrep.experiment.schema import EnvConfig, TrainConfig
from flowrep.transforms import representation_stack


def device(name: str) -> torch.device:
    """Returns the named device; "auto" is a CUDA device if there is one, else the CPU."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return usable_device(name)


def env(config: EnvConfig, **changes: Any) -> EnvBase:
    """Returns the env that the config describes; `changes` replace arguments of `make_env`.

    Observations include `is_init`, by which the replay memory sees that an episode begins.
    """
    num_envs = changes.get("num_envs", config.num_envs)
    num_workers = changes.get("num_workers", config.num_workers)
    if num_workers == "auto":
        on_cpu = device(config.device).type == "cpu"  # where updates need cores of their own
        busy = config.threads if isinstance(config, TrainConfig) and on_cpu else 0
        num_workers = worker_count(num_envs, busy)
    arguments: dict[str, Any] = {
        "scene": config.scene,
        "representations": config.representations,
        "flow": dict(config.flow),
        "motion": config.motion,
        "noise": config.noise,
        "num_envs": num_envs,
        "device": device(config.device),
        "speed": config.speed,
    }
    arguments |= changes | {"num_workers": num_workers}
    maps = arguments["representations"]
    arguments["representations"] = {name: _described(name, maps[name]) for name in maps}
    return make_env(**arguments).append_transform(InitTracker())


def training(config: TrainConfig) -> tuple[TrainConfig, EnvBase, Algorithm]:
    """Returns a training's config as it runs on this machine, its env and its agent, untrained."""
    config = with_precision(config)
    share_cores(config)
    torch.manual_seed(config.seed)
    streets = env(config, compiled=config.compiled)
    # Env i draws its episodes from seed · num_envs + i: runs of two seeds share none.
    streets.set_seed(config.seed * config.num_envs)
    # TorchRL's storage starts multiprocessing's resource tracker, which a SIGHUP would end.
    with sheltered():
        return config, streets, agent(config, streets)


def agent(config: TrainConfig, env: EnvBase) -> Algorithm:
    """Returns the config's algorithm, untrained, for the env's specs."""
    maker, options = algorithm(config.algorithm)
    images = {}
    if getattr(options, "mirror", False):
        images["mirror_image"] = make_mirror(env.base_env.scene, config.representations)
    specs, run = _task(config, env)
    return maker(*specs, options, **run, **images)


def policy(config: TrainConfig, env: EnvBase) -> Any:
    """Returns the config's policy, untrained, without the rest of the agent."""
    maker, options = algorithm(config.algorithm)
    specs, run = _task(config, env)
    return maker.make_policy(*specs, options, **run)


def _task(config: TrainConfig, env: EnvBase) -> tuple[tuple[Any, ...], dict[str, Any]]:
    specs = env.observation_spec, env.action_spec, list(config.representations)
    return specs, {"total_frames": config.total_frames, "device": device(config.device)}


def algorithm(section: AlgorithmOptions) -> tuple[Any, Any]:
    """Returns the class that a section names, and its options; checks those of a user's class."""
    maker = _class("algorithm", section.target, Algorithm)
    if section.target in ALGORITHMS:
        return maker, section
    whole: Any = create_model("Config", algorithm=(maker.OPTIONS, ...))
    return maker, validated(whole, {"algorithm": section.plain()}).algorithm


def check(config: TrainConfig) -> None:
    """Checks, before a run has a folder, what needs PyTorch to be checked.

    That is the device and the number of threads, the classes that are named, and all options that
    the algorithm and the transforms of maps, flow and noise take.
    """
    device(config.device)
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
        )
    except ValueError as error:
        raise UsageError(f"representations, flow or noise: {error}") from error


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


def with_precision(config: TrainConfig, precision: str | None = None) -> TrainConfig:
    """Returns a config with this precision, or its own; "auto" is replaced by this machine's."""
    section = config.algorithm
    _, options = algorithm(section)
    if not hasattr(options, "precision"):  # of a user's algorithm
        return config
    name = options.precision if precision is None else precision
    chosen = {"precision": resolved_precision(name, device(config.device))}
    return config.model_copy(update={"algorithm": section.model_copy(update=chosen)})


def share_cores(config: EnvConfig) -> None:
    """Limits this process to one thread on a CPU, except for updates and estimated flow.

    Nothing else is large enough to gain from a second thread. If another program is busy, threads
    that wait for each other make a step take up to a hundred times as long.
    """
    if device(config.device).type == "cpu" and config.flow.source == "exact":
        torch.set_num_threads(1)


def evaluation_workers(config: EnvConfig, num_envs: int) -> int:
    """Returns the number of processes that step an evaluation's environments."""
    if isinstance(config.num_workers, int):
        return min(config.num_workers, num_envs)
    return worker_count(num_envs // ENVS_PER_WORKER)
