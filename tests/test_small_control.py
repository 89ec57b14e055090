"""The benchmark's control problem: what its best is, and that a short training beats chance."""

import importlib.util
from pathlib import Path

import pytest
import torch

PATH = Path(__file__).parents[1] / "benchmarks" / "small_control.py"


@pytest.fixture(scope="module")
def small_control():
    spec = importlib.util.spec_from_file_location("small_control", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_best_policy_reaches_the_return_that_is_called_the_best(small_control):
    torch.manual_seed(0)
    games = small_control.Follow(4000)

    def towards_the_ball(tensordict):
        return tensordict.set("action", (games.ball - games.paddle).sign() + 1)

    reward = games.rollout(small_control.CELLS - 1, towards_the_ball)["next", "reward"]
    # the standard deviation of a return is 0.27, of their mean 0.004
    assert reward.sum(1).mean().item() == pytest.approx(small_control.BEST, abs=0.02)


@pytest.mark.slow
def test_discrete_sac_learns_to_follow_the_ball(small_control):
    trained = small_control.train(small_control.flowrep_learner, 6000, seed=0)
    # standing still or going one way brings a ninth
    assert trained > 0.18
