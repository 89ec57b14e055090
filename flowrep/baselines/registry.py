"""All baselines by name, the simple ones themselves, and a baseline as a policy."""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from flowrep.baselines.planner import Planner
from flowrep.envs import StreetEnv, street_envs
from flowrep.scenes.vehicle import NO_OP, YAW_SIGN

Baseline = Callable[[StreetEnv], int]
"""Returns the next action; may read the env's whole state."""


def never_turn(env: StreetEnv) -> int:
    """Returns NO_OP, so that the vehicle drives straight on."""
    return NO_OP


class RandomActions:
    """Draws actions uniformly, with a generator for each episode."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)

    def __call__(self, env: StreetEnv) -> int:
        """Returns one of the three actions."""
        if not env.episode.steps:
            # The 0 means nothing now, but without it stored evaluations would have other draws.
            self._rng = np.random.default_rng((env.episode.seed, 0))
        return int(self._rng.integers(len(YAW_SIGN)))


BASELINES: dict[str, Callable[[], Baseline]] = {
    "planner": Planner,
    # It tries wide margins first, because people won't be where it expects them.
    "speed_blind": lambda: Planner((100,), (1.0, 0.5, 0.1), sees_speed=False),
    "never_turn": lambda: never_turn,
    "random": RandomActions,
}


class BaselinePolicy:
    """A baseline, by its name in `BASELINES`, as a policy for `evaluate`."""

    ENV: ClassVar[dict[str, Any]] = {"representations": {}, "num_workers": 0, "device": "cpu"}
    """Arguments of `make_env` for an env that renders nothing: a baseline needs no observation."""

    def __init__(self, name: str) -> None:
        self.name = name

    def enter(self, env: EnvBase) -> None:
        """From now on, chooses for the streets of an env that `make_env` made without workers."""
        self._streets = street_envs(env)
        self._baselines = [BASELINES[self.name]() for _ in self._streets]

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes `action` for the streets in `env_id`."""
        ids = tensordict["env_id"].tolist()
        actions = [self._baselines[i](self._streets[i]) for i in ids]
        return tensordict.set("action", torch.tensor(actions, device=tensordict.device))
