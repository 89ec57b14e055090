"""What a row of metrics.csv is made of: the last episodes, the updates since the row before."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch._subclasses.fake_tensor import FakeTensorMode

from flowrep.experiment.recent import Means, RecentEpisodes

RUNNING, SUCCESS, COLLISION = 0, 1, 2


def step(rewards, outcomes):
    """A step of as many streets; an outcome other than 0 ends the episode."""
    after = {
        "reward": torch.tensor(rewards)[:, None],
        "outcome": torch.tensor(outcomes, dtype=torch.uint8)[:, None],
        "done": torch.tensor(outcomes)[:, None] != RUNNING,
    }
    return TensorDict({"next": after}, [len(rewards)])


STEPS = [
    step([1.0, 10.0], [RUNNING, RUNNING]),
    step([2.0, 20.0], [RUNNING, COLLISION]),  # the second street: return 30 in 2 steps
    step([4.0, 40.0], [SUCCESS, RUNNING]),  # the first: return 7 in 3
    step([8.0, 80.0], [RUNNING, SUCCESS]),  # the second's next one: return 120 in 2
]


def test_episodes_of_each_street_are_summed_up_apart():
    recent = RecentEpisodes()
    assert all(math.isnan(value) for value in recent.summary().values())
    for each in STEPS:
        recent.add(each)
    summary = recent.summary()
    assert summary["success"] == pytest.approx(2 / 3)
    assert summary["collision"] == pytest.approx(1 / 3)
    assert summary["out_of_bounds"] == summary["timeout"] == 0.0
    assert summary["return"] == pytest.approx((30 + 7 + 120) / 3)
    assert summary["length"] == pytest.approx((2 + 3 + 2) / 3)


def test_episodes_that_run_across_a_checkpoint_are_summed_up_whole():
    before, after = RecentEpisodes(), RecentEpisodes()
    for each in STEPS[:2]:
        before.add(each)
    after.restore(before.state())
    for each in STEPS[2:]:
        before.add(each)
        after.add(each)
    assert after.summary() == before.summary()


def test_only_the_last_hundred_episodes_count():
    recent = RecentEpisodes()
    for number in range(103):
        recent.add(step([float(number)], [SUCCESS if number < 4 else COLLISION]))
    assert recent.summary()["success"] == 0.01  # number 3 is the first of the last hundred
    assert recent.summary()["return"] == sum(range(3, 103)) / 100


def test_a_metric_is_the_mean_over_its_interval_and_not_the_last_batch():
    means = Means()
    assert means.take() == {}
    reused = torch.tensor(0.0)  # as a CUDA graph gives the same tensor again and again
    for value in (1.0, 2.0, 6.0):
        means.add({"q_loss": reused.fill_(value)})
    assert means.take() == {"q_loss": 3.0}
    assert means.take() == {}
    means.add({"q_loss": torch.tensor(5.0)})
    assert means.take() == {"q_loss": 5.0}


def test_an_interval_across_a_checkpoint_has_the_mean_of_all_of_it():
    before, after = Means(), Means()
    before.add({"q_loss": torch.tensor(1.0)})
    after.restore(before.state())
    after.add({"q_loss": torch.tensor(4.0)})
    assert after.take() == {"q_loss": 2.5}
    assert before.take() == {"q_loss": 1.0}


def test_updates_on_a_gpu_go_on_with_sums_from_a_file():
    with FakeTensorMode():  # knows CUDA's rules without a GPU
        means = Means()
        means.restore({"sums": {"q_loss": torch.tensor(1.0)}, "count": 1})
        means.add({"q_loss": torch.ones((), device="cuda")})
        assert means.state()["sums"]["q_loss"].device.type == "cuda"
