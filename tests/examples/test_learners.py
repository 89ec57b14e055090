"""Other people's learners run on flowrep's streets: each example trains for 128 steps."""

import importlib

import pytest
import torch


@pytest.mark.slow
@pytest.mark.parametrize("example", ["stable_baselines3_ppo", "cleanrl_ppo", "torchrl_ppo"])
def test_the_example_learns_from_representations(example):
    if example == "stable_baselines3_ppo":
        pytest.importorskip("stable_baselines3", reason="the example's learner is of it")
    train = importlib.import_module(f"examples.{example}").train

    def weights(steps: int, rollout_length: int) -> list[torch.Tensor]:
        trained = train(steps, num_envs=2, rollout_length=rollout_length)
        module = getattr(trained, "policy", trained)
        return [parameter.detach().clone() for parameter in module.parameters()]

    # From the same seed, and so from the same weights: one rollout of 2 x 4 steps, and four of
    # 2 x 16, in which episodes end.
    once, often = weights(8, 4), weights(128, 16)
    assert sum(weight.numel() for weight in often) > 1_000_000
    assert all(weight.isfinite().all() for weight in often)
    assert all(not torch.equal(a, b) for a, b in zip(once, often) if a.ndim > 1)
