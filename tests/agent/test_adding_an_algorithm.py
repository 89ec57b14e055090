"""docs/adding_an_algorithm.md: its class and its YAML file make an algorithm."""

import importlib.util
import re
from pathlib import Path

import torch
import yaml
from torchrl.data import Categorical

DOCS = Path(__file__).parents[2] / "docs" / "adding_an_algorithm.md"


def block(language):
    (found,) = re.findall(rf"```{language}\n(.*?)```", DOCS.read_text("utf-8"), re.DOTALL)
    return found


def test_the_example_learns_and_takes_the_options_of_its_yaml(
    tmp_path, observation_spec, random_steps
):
    (tmp_path / "sarsa.py").write_text(block("python"), encoding="utf-8")
    spec = importlib.util.spec_from_file_location("sarsa", tmp_path / "sarsa.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    options = yaml.safe_load(block("yaml"))
    algorithm = getattr(module, options.pop("_target_").rpartition(".")[2])
    assert algorithm.OPTIONS(**options) == algorithm.OPTIONS()

    small = algorithm.OPTIONS(**options, batch_size=8, hidden_size=32)
    agent = algorithm(observation_spec, Categorical(3), ["flow", "seg"], small, total_frames=500)
    action = agent.policy(random_steps(5).exclude("action"))["action"]
    assert action.shape == (5,)
    for frames in range(5, 105, 5):
        agent.remember(random_steps(5))
        for _ in range(agent.updates_due(frames)):
            metrics = agent.update(agent.sample())
    assert agent.updates == 9
    assert set(metrics) == set(agent.metric_names())
    assert all(torch.isfinite(value) for value in metrics.values())
