"""Builds the env and the agent that a resolved config describes."""

import inspect
import multiprocessing
from collections.abc import Mapping, Sequence
from functools import partial
from pkgutil import resolve_name
from typing import Any

import torch
from torchrl.envs import EnvBase, InitTracker

from flowrep.agent import Algorithm
from flowrep.config import UsageError
from flowrep.config.algorithms import ALGORITHMS
from flowrep.config.violations import closest
from flowrep.envs import make_env
from flowrep.envs.workers import available_cores
from flowrep.experiment.arena import Agent, Arena
from flowrep.experiment.arena_team import AnyArena, ArenaTeam, can_travel
from flowrep.experiment.env_pool import EnvPool
from flowrep.scenes import load_scene
from flowrep.simulator.camera import choose_renderer

Config = Mapping[str, Any]

ENVS_PER_ARENA = 24  # at least, in a process of its own: a step of few costs as much as one of many


def choose_device(name: str) -> torch.device:
    """Returns the named device; "auto" is a CUDA device if there is one, else the CPU.

    Raises:
        UsageError: if torch does not know the device, or this machine lacks it.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UsageError(f"device '{name}' can't be used: {reason}. Try device=cpu") from None


def choose_workers(num_workers: Any, num_envs: int) -> int:
    """Returns the number of worker processes; for "auto" one per core, if there are several.

    Inside a process pool, such as that of `hydra/launcher=joblib`, "auto" is 0, since other jobs
    use the other cores.

    Raises:
        UsageError: if it is neither "auto" nor a whole number from 0 to `num_envs`.
    """
    if num_workers == "auto":
        if multiprocessing.current_process().name != "MainProcess":
            return 0
        cores = available_cores()
        return min(cores, num_envs) if cores > 1 and num_envs > 1 else 0
    if not isinstance(num_workers, int) or not 0 <= num_workers <= num_envs:
        raise UsageError(
            f"num_workers should be auto or a whole number up to num_envs={num_envs}, 0 for none, "
            f"not {num_workers!r}"
        )
    return num_workers


def env_from_config(config: Config, **changes: Any) -> EnvBase:
    """Returns the env that the config describes; `changes` override arguments of `make_env`.

    Observations include `is_init`, which marks the beginning of an episode for the replay memory.
    """
    num_envs: int = changes.get("num_envs") or config["num_envs"]
    num_workers = changes.get("num_workers", config["num_workers"])
    if num_workers == "auto" and not _workers_help(config):
        num_workers = 0
    arguments = {
        "scene": config["scene"],
        "representations": config["representations"],
        "flow": config["flow"],
        "noise": config["noise"],
        "num_envs": num_envs,
        "device": choose_device(config["device"]),
        "speed": config["speed"],
        "renderer": config["renderer"],
    }
    workers = {"num_workers": choose_workers(num_workers, num_envs)}
    env = make_env(**(arguments | changes | workers))
    return env.append_transform(InitTracker())


def _workers_help(config: Config) -> bool:
    """Returns whether training is faster if other processes step the environments.

    A learner on a CPU of two cores needs both, and the rasteriser makes steps cheap.
    """
    if available_cores() > 2 or choose_device(config["device"]).type != "cpu":
        return True
    return config["flow"]["source"] != "exact" or choose_renderer(config["renderer"]) == "pybullet"


def arena_from_config(config: Config, agents: Sequence[Agent], num_envs: int) -> AnyArena:
    """Returns what evaluates agents in the config's scene.

    On a CPU, each of several processes takes whole episodes if it has enough environments;
    otherwise workers step the environments of one arena.
    """
    scene = load_scene(config["scene"])
    workers = min(choose_workers(config["num_workers"], config["num_envs"]), num_envs)
    renderer = config["renderer"]
    processes = min(workers, num_envs // ENVS_PER_ARENA)
    if processes > 1 and can_travel(agents):
        return ArenaTeam(
            scene, agents, num_envs=num_envs, num_processes=processes, renderer=renderer
        )
    pool = partial(EnvPool, num_envs=num_envs, num_workers=workers, renderer=renderer)
    return Arena(scene, agents, pool)


def agent_from_config(config: Config, env: EnvBase, trust: str | None = None) -> Algorithm:
    """Returns the config's algorithm, untrained, for the env's specs.

    Args:
        config: the config of a run.
        env: the env that the config describes.
        trust: a class outside flowrep that may be imported, see `algorithm_class`.
    """
    arguments, options = _arguments(config, env)
    return algorithm_class(config["algorithm"], trust)(*arguments, **options)


def policy_from_config(config: Config, env: EnvBase, trust: str | None = None) -> Any:
    """Returns the untrained policy of the config's algorithm alone; see `agent_from_config`."""
    arguments, options = _arguments(config, env)
    return algorithm_class(config["algorithm"], trust).make_policy(*arguments, **options)


def algorithm_class(section: Mapping[str, Any], trust: str | None) -> Any:
    """Returns the class that a config's `_target_` names, one of flowrep's or the trusted one.

    Importing a module runs its code, and a config may come from somebody else. A class outside
    flowrep is therefore imported only if the command line names it.

    Args:
        section: a config's `algorithm`.
        trust: the full name of a class outside flowrep that may be imported.

    Raises:
        UsageError: the class is not trusted, is not an algorithm, or has other options.
    """
    target = section["_target_"]
    if target not in ALGORITHMS and target != trust:
        raise UsageError(
            f"the run's algorithm is {target}, which is not one of flowrep's, and loading it runs "
            f"code of its author: if you trust it, add trust={target}"
        )
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
        _check_options(section, found.options())
    return found


def _check_options(section: Mapping[str, Any], known: Mapping[str, inspect.Parameter]) -> None:
    """Raises UsageError for an unknown option, and for a missing one without a default."""
    options = [key for key in section if key != "_target_"]
    for key in options:
        if key not in known:
            raise UsageError(
                f"unknown key '{key}' of 'algorithm'{closest(key, list(known))}; "
                f"{section['_target_']} has: {', '.join(known)}"
            )
    for name, parameter in known.items():
        if parameter.default is inspect.Parameter.empty and name not in options:
            raise UsageError(f"'algorithm.{name}' needs a value: +algorithm.{name}=...")


def _arguments(config: Config, env: EnvBase) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Returns the arguments of the config's algorithm, by position and by name."""
    options = {key: value for key, value in config["algorithm"].items() if key != "_target_"}
    specs = env.observation_spec, env.action_spec, list(config["representations"])
    device = choose_device(config["device"])
    return specs, {"total_frames": config["total_frames"], "device": device} | options
