"""Builds what a config describes: env, agent, policy, device. Below it nobody sees a config."""

from __future__ import annotations

import multiprocessing
from inspect import signature
from pkgutil import resolve_name
from typing import Any

import torch
from torchrl.envs import EnvBase, InitTracker

from flowrep.agent import Algorithm
from flowrep.agent.observation import resolved_precision
from flowrep.config import UsageError
from flowrep.config.schema import ALGORITHMS, AnyAlgorithm, EnvConfig, TrainConfig
from flowrep.envs import make_env, make_mirror
from flowrep.envs.torchrl_env import usable_device
from flowrep.envs.workers import available_cores

ENVS_PER_WORKER = 24  # of an evaluation: fewer aren't worth the start of a process


def device(name: str) -> torch.device:
    """Returns the named device; "auto" is a CUDA device if there is one, else the CPU."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return usable_device(name)


def env(config: EnvConfig, **changes: Any) -> EnvBase:
    """Returns the env that the config describes, with changes of `make_env`'s arguments.

    Observations include `is_init`, which marks the beginning of an episode for the replay memory.
    """
    arguments: dict[str, Any] = {
        "scene": config.scene,
        "representations": config.representations,
        "flow": config.flow.plain(),
        "motion": config.motion,
        "noise": config.noise.plain(),
        "num_envs": config.num_envs,
        "device": device(config.device),
        "speed": config.speed,
        "renderer": config.renderer,
    }
    arguments |= changes
    num_workers = changes.get("num_workers", config.num_workers)
    if num_workers == "auto":
        num_workers = worker_count(arguments["num_envs"], busy_cores=_threads(config))
    arguments["num_workers"] = num_workers
    return make_env(**arguments).append_transform(InitTracker())


def share_cores(config: EnvConfig) -> None:
    """Has this process use one thread on a CPU, except for updates and estimated flow.

    Nothing else is large enough to gain by a second one, and beside another program's work, threads
    that wait for each other make a step take up to a hundred times as long.
    """
    if device(config.device).type == "cpu" and config.flow.source == "exact":
        torch.set_num_threads(1)


def with_precision(config: TrainConfig) -> TrainConfig:
    """Returns a new run's config with the number format that `precision=auto` is here."""
    section = config.algorithm
    options = algorithm_class(section).options()
    if "precision" not in options:  # an algorithm of the user's own
        return config
    asked = section.options().get("precision", options["precision"].default)
    chosen = {"precision": resolved_precision(asked, device(config.device))}
    return config.model_copy(update={"algorithm": section.model_copy(update=chosen)})


def worker_count(num_envs: int, busy_cores: int = 0) -> int:
    """Returns the number of worker processes: one for each core that isn't busy."""
    # in a process of a pool, such as that of hydra/launcher=joblib, others use the other cores
    is_in_pool = multiprocessing.current_process().name != "MainProcess"
    cores = available_cores()
    return 0 if is_in_pool or min(cores, num_envs) < 2 else min(cores - busy_cores, num_envs)


def _threads(config: EnvConfig) -> int:
    """Returns the number of cores that the updates of a training need."""
    if not isinstance(config, TrainConfig) or device(config.device).type != "cpu":
        return 0
    return min(config.threads, available_cores())


def evaluation_workers(config: EnvConfig, num_envs: int) -> int:
    """Returns the number of processes that step an evaluation's environments."""
    if isinstance(config.num_workers, int):
        return min(config.num_workers, num_envs)
    return worker_count(num_envs // ENVS_PER_WORKER)


def agent(config: TrainConfig, env: EnvBase) -> Algorithm:
    """Returns the config's algorithm, untrained, for the env's specs."""
    arguments, options = _arguments(config, env)
    if options.get("mirror"):
        options["mirror_image"] = make_mirror(config.scene, config.representations)
    return algorithm_class(config.algorithm)(*arguments, **options)


def policy(config: TrainConfig, env: EnvBase) -> Any:
    """Returns the untrained policy of the config's algorithm alone."""
    arguments, options = _arguments(config, env)
    return algorithm_class(config.algorithm).make_policy(*arguments, **options)


def _arguments(config: TrainConfig, env: EnvBase) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Returns the arguments of the config's algorithm, by position and by name."""
    specs = env.observation_spec, env.action_spec, list(config.representations)
    of_the_run = {"total_frames": config.total_frames, "device": device(config.device)}
    return specs, of_the_run | config.algorithm.options()


def algorithm_class(section: AnyAlgorithm) -> Any:
    """Returns the class that a config names, after checking that it is one of an algorithm."""
    target = section.target
    try:
        found = resolve_name(target)
    except (ImportError, AttributeError, ValueError) as error:
        raise UsageError(
            f"algorithm._target_={target} can't be imported: {error}; is its folder in PYTHONPATH?"
        ) from None
    if not (isinstance(found, type) and issubclass(found, Algorithm)):
        raise UsageError(
            f"algorithm._target_={target} is not a subclass of flowrep.agent.Algorithm"
        )
    if target not in ALGORITHMS:
        try:
            required = {"total_frames": 0, "device": None}
            signature(found).bind(None, None, None, **required | section.options())
        except TypeError as error:
            known = ", ".join(found.options())
            raise UsageError(f"algorithm: {error}; the options of {target} are: {known}") from None
    return found
