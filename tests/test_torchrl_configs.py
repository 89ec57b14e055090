"""flowrep.torchrl_configs: env, losses and replay as a TorchRL project names them in configs."""

from __future__ import annotations

import dataclasses
import inspect
import subprocess
import sys

import pytest
import torch

hydra = pytest.importorskip("hydra")
pytest.importorskip("pybullet", reason="the environment is simulated in PyBullet")
configs = pytest.importorskip("flowrep.torchrl_configs", exc_type=ImportError)

from hydra.core.config_store import ConfigStore  # noqa: E402
from hydra.utils import get_object, instantiate  # noqa: E402
from torchrl.data import TensorDictReplayBuffer  # noqa: E402
from torchrl.envs import InitTracker  # noqa: E402

from flowrep.agent.networks import (  # noqa: E402
    DiscreteActions,
    MapNetwork,
    acting_network,
)

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
    spec, keys = env.observation_spec, ["ego", "obj"]
    device = torch.device("cpu")
    policy = acting_network(
        spec, env.action_spec, keys, device=device, precision="fp32", hidden_size=16
    )
    return policy.network


@pytest.mark.parametrize(("group", "name"), configs.CONFIGS)
def test_names_and_defaults_are_those_of_the_signature(group, name):
    stored = ConfigStore.instance().load(f"{group}/{name}.yaml").node
    target = get_object(stored["_target_"])
    made_by = target.__init__ if inspect.isclass(target) else target
    expected = [key for key in inspect.signature(made_by).parameters if key != "self"]
    given = {field.name for field in dataclasses.fields(configs.CONFIGS[group, name])}
    assert given == {*expected, "_target_", "_convert_", "_partial_"}


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


@pytest.mark.slow
def test_no_config_of_torchrl_s_is_replaced():
    code = (
        "import torchrl.trainers.algorithms.configs\n"
        "from hydra.core.config_store import ConfigStore\n"
        "listed = ConfigStore.instance().list\n"
        "groups = ['env', 'loss', 'sampler', 'storage', 'replay_buffer', 'transform']\n"
        "before = {(group, name) for group in groups for name in listed(group)}\n"
        "from flowrep import torchrl_configs\n"
        "from flowrep.transforms.hydra_configs import CONFIGS\n"
        "ours = {*torchrl_configs.CONFIGS, *(('transform', name) for name in CONFIGS)}\n"
        "print(sorted(before & {(group, name + '.yaml') for group, name in ours}))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"
