"""Runs updates of ML-Agents' own SAC on request; started by update_against_mlagents.py.

It runs in its own environment, with the `mlagents` package and without flowrep, and answers each
line on stdin with the seconds of one update. mlagents 0.28 was written for torch 1.8, numpy 1.2x
and Python 3.9; names missing in newer versions are added here, and its trainer is unchanged.
"""
# ruff: noqa: E402

import contextlib
import sys
import time
import warnings

warnings.filterwarnings("ignore")

import cattr
import numpy as np

for _name, _type in {"bool": bool, "int": int, "float": float, "object": object}.items():
    if _name not in np.__dict__:
        setattr(np, _name, _type)
_register = cattr.register_structure_hook


def _register_what_can_be(*arguments):
    with contextlib.suppress(TypeError):  # hooks for reading YAML, which nothing here does
        _register(*arguments)


cattr.register_structure_hook = _register_what_can_be

import torch
from mlagents.trainers.buffer import AgentBuffer, BufferKey, RewardSignalUtil
from mlagents.trainers.policy.torch_policy import TorchPolicy
from mlagents.trainers.sac.optimizer_torch import TorchSACOptimizer
from mlagents.trainers.settings import (
    EncoderType,
    NetworkSettings,
    RewardSignalSettings,
    RewardSignalType,
    SACSettings,
    ScheduleType,
    TrainerSettings,
)
from mlagents.trainers.trajectory import ObsUtil
from mlagents_envs.base_env import (
    ActionSpec,
    BehaviorSpec,
    DimensionProperty,
    ObservationSpec,
    ObservationType,
)

MAPS, CHANNELS, ACTIONS = 2, 2, 3


def make_update(side, batch):
    properties = (
        DimensionProperty.TRANSLATIONAL_EQUIVARIANCE,
        DimensionProperty.TRANSLATIONAL_EQUIVARIANCE,
        DimensionProperty.NONE,
    )
    maps = [
        ObservationSpec((side, side, CHANNELS), properties, ObservationType.DEFAULT, f"map{i}")
        for i in range(MAPS)
    ]
    # The paper's Table II.
    settings = TrainerSettings(
        hyperparameters=SACSettings(
            batch_size=batch,
            buffer_size=10_240,
            learning_rate=3e-4,
            learning_rate_schedule=ScheduleType.LINEAR,
            init_entcoef=0.5,
            steps_per_update=10,
        ),
        network_settings=NetworkSettings(
            hidden_units=512, num_layers=1, vis_encode_type=EncoderType.NATURE_CNN
        ),
        reward_signals={RewardSignalType.EXTRINSIC: RewardSignalSettings(gamma=0.99)},
        max_steps=2_000_000,
    )
    behavior = BehaviorSpec(maps, ActionSpec.create_discrete((ACTIONS,)))
    policy = TorchPolicy(0, behavior, settings, separate_critic=True)
    optimizer = TorchSACOptimizer(policy, settings)
    rng = np.random.default_rng(0)
    transitions = AgentBuffer()

    def fill(key, values):
        transitions[key].extend(list(values))

    for i in range(MAPS):
        for name in (ObsUtil.get_name_at(i), ObsUtil.get_name_at_next(i)):
            fill(name, rng.random((batch, side, side, CHANNELS), dtype=np.float32))
    fill(BufferKey.DISCRETE_ACTION, rng.integers(ACTIONS, size=(batch, 1)).astype(np.float32))
    fill(BufferKey.ACTION_MASK, np.zeros((batch, ACTIONS), dtype=np.float32))
    fill(RewardSignalUtil.rewards_key("extrinsic"), rng.random(batch, dtype=np.float32))
    fill(BufferKey.DONE, np.ones(batch, dtype=np.float32))
    fill(BufferKey.MASKS, np.ones(batch, dtype=np.float32))
    return lambda: optimizer.update(transitions, 1)


def main():
    side, batch = int(sys.argv[1]), int(sys.argv[2])
    if len(sys.argv) > 3:
        torch.set_num_threads(int(sys.argv[3]))
    update = make_update(side, batch)
    print("ready", flush=True)
    for _ in sys.stdin:
        start = time.perf_counter()
        update()
        print(time.perf_counter() - start, flush=True)


if __name__ == "__main__":
    main()
