"""TorchRL's contract again, on transforms that were pickled and copied before their first use.

The cases that fork worker processes are left to `test_contract`; spawned workers, which unpickle
what they run, have a test of their own here.
"""

from __future__ import annotations

import copy
import functools
import pickle

import pytest
import torch
from torchrl.envs import Compose, ParallelEnv, TransformedEnv

from flowrep.transforms import FlowFactorize, RawFlow, representation_stack
from tests.transforms import test_contract
from tests.transforms.contract import TransformContract
from tests.transforms.fake_env import INTRINSICS, NUM_CLASSES, FakeSensorEnv


def of_copies(contract: type[TransformContract]) -> type[TransformContract]:
    """Returns a transform's contract, fulfilled by a copy of what was pickled; its tests are slow.

    The fast part has the originals' contracts.
    """

    def make(self):
        return copy.deepcopy(pickle.loads(pickle.dumps(contract.make(self))))

    left_out = dict.fromkeys(["test_parallel_trans_env_check", "test_trans_parallel_env_check"])
    return type(
        f"{contract.__name__}Copy",
        (contract,),
        {"make": make, "pytestmark": pytest.mark.slow, **left_out},
    )


for _name, _contract in list(vars(test_contract).items()):
    if _name.startswith("Test"):
        globals()[f"{_name}Copy"] = of_copies(_contract)


@pytest.mark.parametrize("intrinsics", [INTRINSICS, ("sensor", "K")])
def test_a_copied_env_has_the_specs_of_its_original(intrinsics):
    outputs = ["valid", "ego", "obj"]
    stack = Compose(RawFlow(intrinsics), FlowFactorize(intrinsics, outputs=outputs))
    env = TransformedEnv(FakeSensorEnv((3,)), stack)
    copied = copy.deepcopy(env)
    assert copied.observation_spec == env.observation_spec
    assert torch.equal(copied.rollout(3)["obj"], env.rollout(3)["obj"])


def spawned_env(first_env: int) -> TransformedEnv:
    names = ["raw", "ego", "obj", "depth2", "seg"]
    stack = representation_stack(names, intrinsics=INTRINSICS, num_classes=NUM_CLASSES)
    return TransformedEnv(FakeSensorEnv((), first_env), stack)


@pytest.mark.slow
def test_spawned_workers_give_what_the_same_envs_give_here():
    made = spawned_env(1)  # travels to its worker as it is, unlike what a function makes there
    makers = [functools.partial(spawned_env, 0), functools.partial(copy.deepcopy, made)]
    env = ParallelEnv(2, makers, mp_start_method="spawn")
    try:
        there = env.rollout(4, break_when_any_done=False)
    finally:
        env.close()
    for i in (0, 1):
        here = spawned_env(i).rollout(4, break_when_any_done=False)
        for key in ("raw", "ego", "obj", "depth2", "seg"):
            assert torch.equal(there[i, ...]["next", key], here["next", key])
