"""Streets with pedestrians in PyBullet: gymnasium environments and `make_env` for TorchRL.

What needs PyTorch is imported when it is first asked for. Workers that step environments do without
it, and start in a third of the time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from flowrep.envs import availability as availability  # before imports that need PyBullet
from flowrep.envs.outcome import Outcome
from flowrep.envs.registration import register_environments
from flowrep.envs.street_env import StreetEnv
from flowrep.envs.worker_process import WorkerError
from flowrep.envs.workers import WorkerVectorEnv

if TYPE_CHECKING:
    from flowrep.envs.make import (
        begin_step,
        get_states,
        has_spare_cores,
        make_env,
        set_states,
        street_envs,
    )
    from flowrep.envs.represented import NumericInfo, RepresentationObservation

register_environments()

__all__ = [
    "NumericInfo",
    "Outcome",
    "RepresentationObservation",
    "StreetEnv",
    "WorkerError",
    "WorkerVectorEnv",
    "begin_step",
    "get_states",
    "has_spare_cores",
    "make_env",
    "set_states",
    "street_envs",
]


def __getattr__(name: str) -> Any:
    """Returns what is public and was not imported above."""
    if name not in __all__:
        raise AttributeError(f"module 'flowrep.envs' has no attribute '{name}'")
    is_represented = name in ("NumericInfo", "RepresentationObservation")
    module = import_module(f"flowrep.envs.{'represented' if is_represented else 'make'}")
    return getattr(module, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
