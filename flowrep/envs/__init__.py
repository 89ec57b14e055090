"""Streets with pedestrians in PyBullet: gymnasium envs and `make_env` for TorchRL.

Importing this module registers the envs with gymnasium, which since 1.0 finds no plugins by itself.
`gymnasium.make("flowrep.envs:flowrep/StraightRoad-v0")` imports it first.

Names that need PyTorch are imported on first use, because worker processes step envs without it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from flowrep.extras import require

require("flowrep.envs", "sim", "pybullet", "gymnasium", "shapely", "yaml", "numba")

import gymnasium

from flowrep.envs.street_env import Outcome, StreetEnv
from flowrep.envs.workers import WorkerError, WorkerVectorEnv

if TYPE_CHECKING:
    from flowrep.envs.gym_wrappers import NumericInfo, RepresentationObservation
    from flowrep.envs.torchrl_env import (
        begin_step,
        get_states,
        has_spare_cores,
        make_env,
        make_mirror,
        set_states,
        street_envs,
    )

SCENE_BY_ID = {
    "flowrep/StraightRoad-v0": "straight_road",
    "flowrep/STurn-v0": "s_turn",
    "flowrep/HShapedPathways-v0": "h_shaped_pathways",
    "flowrep/ThreeWayJunction-v0": "three_way_junction",
}
"""The scene of each env that is registered with gymnasium."""

for _id, _scene in SCENE_BY_ID.items():
    gymnasium.register(
        _id,
        entry_point="flowrep.envs.gym_wrappers:make_street",
        vector_entry_point="flowrep.envs.gym_wrappers:make_streets",
        kwargs={"scene": _scene},
    )

__all__ = [
    "NumericInfo", "Outcome", "RepresentationObservation", "StreetEnv", "WorkerError",
    "WorkerVectorEnv", "begin_step", "get_states", "has_spare_cores", "make_env", "make_mirror",
    "set_states", "street_envs",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Returns a public name that was not imported above."""
    if name not in __all__:
        raise AttributeError(f"module 'flowrep.envs' has no attribute '{name}'")
    is_wrapper = name in ("NumericInfo", "RepresentationObservation")
    module = import_module(f"flowrep.envs.{'gym_wrappers' if is_wrapper else 'torchrl_env'}")
    return getattr(module, name)
