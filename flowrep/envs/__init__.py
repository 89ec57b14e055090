"""Streets with pedestrians in PyBullet: gymnasium environments and `make_env` for TorchRL."""

import gymnasium

from flowrep.envs.baselines import BASELINES, Drive, RandomDriver, drives, never_turn
from flowrep.envs.loading import load_scene, scene_names
from flowrep.envs.make import get_states, make_env, set_states, streets
from flowrep.envs.outcome import Outcome
from flowrep.envs.planner import Planner
from flowrep.envs.scene import Scene
from flowrep.envs.schema import SceneError
from flowrep.envs.simulator import Simulator as Simulator  # says at once where pybullet is missing
from flowrep.envs.street_env import StreetEnv

gymnasium.register(
    "flowrep/StraightRoad-v0",
    entry_point="flowrep.envs.street_env:StreetEnv",
    kwargs={"scene": "straight_road"},
)

__all__ = [
    "BASELINES",
    "Drive",
    "Outcome",
    "Planner",
    "RandomDriver",
    "Scene",
    "SceneError",
    "StreetEnv",
    "drives",
    "get_states",
    "load_scene",
    "make_env",
    "never_turn",
    "scene_names",
    "set_states",
    "streets",
]
