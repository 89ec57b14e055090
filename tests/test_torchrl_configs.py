"""flowrep.torchrl_configs: env, losses and replay as a TorchRL project names them in configs."""

from __future__ import annotations

import importlib

import pytest
import torch
import torchrl.trainers.algorithms.configs

hydra = pytest.importorskip("hydra")
pytest.importorskip("pybullet", reason="the environment is simulated in PyBullet")
configs = pytest.importorskip("flowrep.torchrl_configs", exc_type=ImportError)

from hydra.core.config_store import ConfigStore  # noqa: E402
from hydra.utils import get_object, instantiate  # noqa: E402
from torchrl.data import TensorDictReplayBuffer  # noqa: E402
from torchrl.envs import InitTracker  # noqa: E402

from flowrep.agent.networks import DiscreteActions, MapNetwork, acting_network  # noqa: E402
from flowrep.transforms import hydra_configs  # noqa: E402

LOSSES = [name for group, name in configs.CONFIGS if group == "loss"]
EXAMPLE = configs.__doc__.partition("```yaml")[2].partition("```")[0]


@pytest.fixture(scope="module")
def env_config(tmp_path_factory):
    """The example of the module's docstring, composed with small maps."""
    folder = tmp_path_factory.mktemp("conf")
    (folder / "main.yaml").write_text(EXAMPLE)
    with hydra.initialize_config_dir(str(folder), version_base="1.3"):
        return hydra.compose("main", overrides=["env.num_envs=2", "memory.capacity=64"])


@pytest.fixture(scope="module")
def env(env_config):
    env = instantiate(env_config.env).append_transform(InitTracker())
    env.set_seed(3)
    yield env
    env.close()


def network_for(env) -> MapNetwork:
    torch.manual_seed(0)
    small = {"device": torch.device("cpu"), "precision": "fp32", "hidden_size": 16}
    return acting_network(env.observation_spec, env.action_spec, ["ego", "obj"], **small).network


def test_the_example_s_env_and_memory_are_flowrep_s(env_config, env):
    memory = instantiate(env_config.memory)(network_for(env).codecs)
    memory.extend(env.rollout(6, break_when_any_done=False))
    batch = memory.sample()
    assert type(memory).__name__ == "ReplayMemory"
    assert batch.batch_size == (256,)
    assert batch["steps_to_next_obs"].unique().tolist() == [1.0, 2.0, 3.0]


def test_a_replay_buffer_of_torchrl_s_is_put_together_of_the_parts(env):
    codecs = network_for(env).codecs
    part = {
        group: instantiate(ConfigStore.instance().load(f"{group}/{name}.yaml").node, **options)
        for group, name, options in [
            ("storage", "rows", {"max_size": 64, "observation_keys": ["ego", "obj"]}),
            ("sampler", "successor", {"n_steps": 2}),
            ("transform", "pack_steps", {}),
        ]
    }
    memory = TensorDictReplayBuffer(
        storage=part["storage"], sampler=part["sampler"], transform=part["transform"](codecs),
        batch_size=32,
    )  # fmt: skip
    memory.extend(env.rollout(5, break_when_any_done=False))
    assert memory.sample()["steps_to_next_obs"].max() == 2


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_is_made_of_the_network_and_the_actions(env, name):
    network = network_for(env)
    make_loss = instantiate(ConfigStore.instance().load(f"loss/{name}.yaml").node)
    loss = make_loss(network, DiscreteActions.from_spec(env.action_spec))
    assert isinstance(loss, get_object(configs.CONFIGS["loss", name]._target_))
    assert {id(p) for p in network.parameters()} <= {id(p) for p in loss.parameters()}


def test_options_reach_the_loss(env_config, env):
    make_loss = instantiate(env_config.loss)
    loss = make_loss(network_for(env), DiscreteActions.from_spec(env.action_spec))
    assert loss.log_alpha.exp().item() == pytest.approx(0.05)
    assert loss.value_estimator.gamma.item() == pytest.approx(0.97)


def test_no_config_of_torchrl_s_is_replaced():
    ours = {*configs.CONFIGS, *(("transform", name) for name in hydra_configs.CONFIGS)}
    importlib.reload(torchrl.trainers.algorithms.configs)  # stores TorchRL's own once more
    store = ConfigStore.instance()
    assert {store.load(f"{group}/{name}.yaml").provider for group, name in ours} == {"flowrep"}
