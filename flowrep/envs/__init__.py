"""Streets with pedestrians in PyBullet: gymnasium environments and `make_env` for TorchRL."""

from flowrep.envs import availability as availability  # before imports that need PyBullet
from flowrep.envs.make import (
    begin_step,
    get_states,
    has_spare_cores,
    make_env,
    set_states,
    street_envs,
)
from flowrep.envs.outcome import Outcome
from flowrep.envs.registration import register_environments
from flowrep.envs.represented import NumericInfo, RepresentationObservation
from flowrep.envs.street_env import StreetEnv
from flowrep.envs.worker_process import WorkerError
from flowrep.envs.workers import WorkerVectorEnv

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
