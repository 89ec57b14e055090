"""Streets with pedestrians in PyBullet: gymnasium environments and `make_env` for TorchRL."""

from flowrep.envs import availability as availability  # before all that it speaks of
from flowrep.envs.baselines import BASELINES, Drive, RandomDriver, drives, never_turn
from flowrep.envs.loading import load_scene, scene_names
from flowrep.envs.make import (
    begin_step,
    get_states,
    has_cores_beside,
    make_env,
    set_states,
    streets,
)
from flowrep.envs.outcome import Outcome
from flowrep.envs.planner import Planner
from flowrep.envs.registration import register_environments
from flowrep.envs.represented import NumericInfo, RepresentationObservation
from flowrep.envs.scene import Scene
from flowrep.envs.schema import SceneError
from flowrep.envs.street_env import StreetEnv
from flowrep.envs.workers import WorkerError, WorkerVectorEnv

register_environments()

__all__ = [
    "BASELINES",
    "Drive",
    "NumericInfo",
    "Outcome",
    "Planner",
    "RandomDriver",
    "RepresentationObservation",
    "Scene",
    "SceneError",
    "StreetEnv",
    "WorkerError",
    "WorkerVectorEnv",
    "begin_step",
    "drives",
    "get_states",
    "has_cores_beside",
    "load_scene",
    "make_env",
    "never_turn",
    "scene_names",
    "set_states",
    "streets",
]
