"""Other people's learners run on flowrep's streets: each example trains for a few steps."""

import importlib

import pytest
import torch


@pytest.mark.slow
@pytest.mark.parametrize(
    ("example", "needs"),
    [
        ("stable_baselines3_ppo", "stable_baselines3"),
        ("cleanrl_ppo", "gymnasium"),
        ("torchrl_ppo", "torchrl"),
    ],
)
def test_the_example_learns_from_representations(example, needs):
    pytest.importorskip("pybullet", reason="the streets are simulated in PyBullet")
    pytest.importorskip(needs, reason=f"the example's learner is {needs}'s")
    train = importlib.import_module(f"examples.{example}").train

    def weights(steps: int) -> list[torch.Tensor]:
        trained = train(steps, num_envs=2, rollout_length=4)
        module = getattr(trained, "policy", trained)
        return [parameter.detach().clone() for parameter in module.parameters()]

    # Two rollouts of 2 x 4 steps, from the same seed and so from the same weights as one.
    once, twice = weights(8), weights(16)
    assert sum(weight.numel() for weight in twice) > 1_000_000
    assert all(weight.isfinite().all() for weight in twice)
    assert any(not torch.equal(a, b) for a, b in zip(once, twice))
