"""The eleven cases that TorchRL asks of every transform, written down once.

A test class inherits `TransformContract`, says how its transform is made and what each output must
be for one frame. Every case then runs the transform the way its name says and compares all
outputs, at the root and under "next", with that.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv, check_env_specs
from torchrl.envs.transforms import Compose, Transform

from tests.transforms.fake_env import FakeSensorEnv

STEPS = 5  # the shortest episode has 3: a rollout crosses resets


class TransformContract:
    def oracles(self) -> dict[NestedKey, Callable[[dict[str, Tensor]], Tensor]]:
        """Returns what one frame's sensor maps must become, by output key."""
        raise NotImplementedError

    def make(self) -> Transform:
        raise NotImplementedError

    def before(self) -> list[Transform]:
        """Returns what has to run before the transform."""
        return []

    def inputs(self) -> TensorDictBase:
        """Returns a trajectory of three envs that holds what the transform reads."""
        env = TransformedEnv(FakeSensorEnv((3,)), Compose(*self.before()))
        return rollout(env)

    def assert_right(self, td: TensorDictBase) -> None:
        """Compares each output, of each element of the batch, with its oracle."""
        for part in (td, td["next"]):
            flat = part.reshape(-1)
            for key, oracle in self.oracles().items():
                got = flat[key]
                want = torch.stack([oracle(sample["sensor"]) for sample in flat])
                assert got.dtype == want.dtype
                torch.testing.assert_close(got, want, atol=2e-5, rtol=1e-5, equal_nan=True)

    def assert_right_env(self, env: EnvBase) -> None:
        try:
            check_env_specs(env, seed=None)
            self.assert_right(rollout(env))
        finally:
            env.close()

    def make_env(self, first_env: int, batch_size: tuple[int, ...] = ()) -> TransformedEnv:
        transform = Compose(*self.before(), self.make())
        return TransformedEnv(FakeSensorEnv(batch_size, first_env), transform)

    def test_single_trans_env_check(self):
        self.assert_right_env(self.make_env(0))

    def test_serial_trans_env_check(self):
        makers = [functools.partial(self.make_env, env) for env in (0, 1)]
        self.assert_right_env(SerialEnv(2, makers))

    @pytest.mark.slow
    def test_parallel_trans_env_check(self):
        makers = [functools.partial(self.make_env, env) for env in (0, 1)]
        self.assert_right_env(ParallelEnv(2, makers, mp_start_method="fork"))

    def test_trans_serial_env_check(self):
        base = SerialEnv(2, [functools.partial(FakeSensorEnv, (), env) for env in (0, 1)])
        self.assert_right_env(TransformedEnv(base, Compose(*self.before(), self.make())))

    @pytest.mark.slow
    def test_trans_parallel_env_check(self):
        makers = [functools.partial(FakeSensorEnv, (), env) for env in (0, 1)]
        base = ParallelEnv(2, makers, mp_start_method="fork")
        self.assert_right_env(TransformedEnv(base, Compose(*self.before(), self.make())))

    def test_transform_no_env(self):
        self.assert_right(self.make()(self.inputs()))

    def test_transform_compose(self):
        composed = Compose(self.make())(self.inputs())
        self.assert_right(composed)
        online = rollout(self.make_env(0, (3,)))
        for key in self.oracles():  # offline equals online, to the last bit
            assert same_bits(composed[key], online[key])
            assert same_bits(composed["next", key], online["next", key])

    def test_transform_env(self):
        env = self.make_env(0, (3,))
        self.assert_right_env(env)
        assert set(self.oracles()) <= set(env.observation_spec.keys(True, True))

    def test_transform_model(self):
        key = next(iter(self.oracles()))
        double = TensorDictModule(lambda x: 2 * x, in_keys=[key], out_keys=["double"])
        td = nn.Sequential(self.make(), double)(self.inputs())
        assert same_bits(td["double"], 2 * td[key])

    @pytest.mark.parametrize("method", ["transform=", "append_transform"])
    def test_transform_rb(self, method):
        storage = LazyTensorStorage(64)
        inputs = self.replay_inputs().reshape(-1)
        if method == "transform=":
            buffer = TensorDictReplayBuffer(storage=storage, transform=self.make(), batch_size=40)
        else:
            buffer = TensorDictReplayBuffer(storage=storage, batch_size=40)
            buffer.append_transform(self.make())
        buffer.extend(inputs)
        torch.manual_seed(0)
        self.assert_right(buffer.sample())  # shuffled, with repetitions

    def replay_inputs(self) -> TensorDictBase:
        """Returns what a replay buffer of single transitions has to store."""
        return self.inputs()

    def test_transform_inverse(self):
        td = TensorDict({"action": torch.tensor([2, 0, 1])}, [3])
        assert (self.make().inv(td) == td).all()


def same_bits(a: Tensor, b: Tensor) -> bool:
    """Returns whether two tensors are equal, holes (nan) included."""
    return torch.equal(a.isnan(), b.isnan()) and torch.equal(a.nan_to_num(), b.nan_to_num())


def rollout(env: EnvBase) -> TensorDictBase:
    return env.rollout(STEPS, break_when_any_done=False)
