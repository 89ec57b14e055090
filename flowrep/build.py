"""From a resolved config to the env and the agent that it describes."""

from collections.abc import Mapping
from typing import Any

import torch
from hydra.utils import get_class
from torchrl.envs import EnvBase

from flowrep.agent import Algorithm
from flowrep.config import UsageError
from flowrep.envs import make_env
from flowrep.envs.workers import available_cores

Config = Mapping[str, Any]


def choose_device(name: str) -> torch.device:
    """Returns the device of that name, for "auto" a CUDA device where there is one.

    Raises:
        UsageError: torch knows no such device, or this machine has none.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UsageError(f"device '{name}' can't be used: {reason}. Try device=cpu") from None


def choose_workers(num_workers: Any, num_envs: int) -> int:
    """Returns how many processes drive `num_envs` streets, for "auto" one a core if there are two.

    Raises:
        UsageError: it is no such number.
    """
    if num_workers == "auto":
        cores = available_cores()
        return min(cores, num_envs) if cores > 1 and num_envs > 1 else 0
    if not isinstance(num_workers, int) or not 0 <= num_workers <= num_envs:
        raise UsageError(
            f"num_workers should be auto or a whole number up to num_envs={num_envs}, 0 for none, "
            f"not {num_workers!r}"
        )
    return num_workers


def build_env(config: Config, **changes: Any) -> EnvBase:
    """Returns the env that the config describes; `changes` go to `make_env` in its place."""
    num_envs: int = changes.get("num_envs") or config["num_envs"]
    num_workers = changes.get("num_workers", config["num_workers"])
    arguments = {
        "scene": config["scene"],
        "representations": config["representations"],
        "flow": config["flow"],
        "num_envs": num_envs,
        "device": choose_device(config["device"]),
        "speed": config["speed"],
        "renderer": config["renderer"],
    }
    workers = {"num_workers": choose_workers(num_workers, num_envs)}
    return make_env(**(arguments | changes | workers))


def build_agent(config: Config, env: EnvBase) -> Algorithm:
    """Returns the config's algorithm, untrained, on what the env emits."""
    algorithm, arguments, options = _algorithm(config, env)
    return algorithm(*arguments, **options)


def build_policy(config: Config, env: EnvBase) -> Any:
    """Returns the acting side of the config's algorithm alone, untrained."""
    algorithm, arguments, options = _algorithm(config, env)
    return algorithm.build_policy(*arguments, **options)


def _algorithm(config: Config, env: EnvBase) -> tuple[Any, tuple[Any, ...], dict[str, Any]]:
    """Returns the algorithm's class and its arguments, by position and by name."""
    options = dict(config["algorithm"])
    algorithm = get_class(options.pop("_target_"))
    specs = env.observation_spec, env.action_spec, list(config["representations"])
    device = choose_device(config["device"])
    return algorithm, specs, {"total_frames": config["total_frames"], "device": device} | options
