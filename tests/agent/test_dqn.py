import pytest
import torch
from torchrl.data import Categorical

from flowrep.agent import DoubleDQN


@pytest.fixture
def make_dqn(observation_spec):
    def make(**changes):
        settings = {
            "total_frames": 1000, "device": "cpu", "precision": "fp32", "learning_rate": 3e-4,
            "initial_epsilon": 1.0, "final_epsilon": 0.1, "exploration_share": 0.2, "gamma": 0.5,
            "tau": 0.25, "hidden_size": 32, "batch_size": 16, "replay_capacity": 100,
            "frames_per_update": 10, "learning_starts": None,
        }  # fmt: skip
        torch.manual_seed(0)
        return DoubleDQN(observation_spec, Categorical(3), ["flow", "seg"], **(settings | changes))

    return make


def test_epsilon_falls_linearly_over_its_share_of_the_frames(make_dqn, random_steps):
    agent = make_dqn(replay_capacity=400)  # from 1 to 0.1 over 200 frames
    for expected in (1 - 0.9 * 80 / 200, 1 - 0.9 * 160 / 200, 0.1, 0.1):
        agent.remember(random_steps(80))
        assert agent.exploration.eps.item() == pytest.approx(expected)


def values(agent, maps, target=False):
    """Q(s, ·) of raw maps."""
    prefix = "target_value_network_params" if target else "value_network_params"
    network = agent.loss.value_network
    packed = maps.empty().update({c.key: c.store(maps[c.key]) for c in agent.codecs})
    with torch.no_grad(), getattr(agent.loss, prefix).to_module(network):
        return network(packed)["action_value"]


def test_the_online_network_chooses_and_the_target_network_values(make_dqn, random_steps, as_batch):
    agent, steps = make_dqn(learning_rate=0.01), random_steps(16)
    batch = as_batch(agent, steps)
    for _ in range(3):  # so that target and online differ
        agent.update(batch.clone())
    q, following = values(agent, steps), steps["next"]
    best = values(agent, following).argmax(1)
    rows = torch.arange(16)
    assert not torch.equal(best, values(agent, following, target=True).argmax(1))
    later = values(agent, following, target=True)[rows, best]
    later = torch.where(following["terminated"].squeeze(1), 0.0, later)
    error = q[rows, steps["action"]] - (following["reward"].squeeze(1) + 0.5 * later)
    losses = agent.losses(batch.clone())
    torch.testing.assert_close(losses["q_loss"].detach(), (error**2).mean())
    torch.testing.assert_close(losses["td_error"], error.abs().mean())


def test_the_target_moves_by_tau(make_dqn, random_steps, as_batch):
    agent, steps = make_dqn(learning_rate=0.01), random_steps(16)
    before = {n: w.clone() for n, w in agent.weights.items()}
    agent.update(as_batch(agent, steps))
    name = "value_network_params.module.0.module.network.head.output.bias"
    moved = before[name] + 0.25 * (agent.weights[name] - before[name])
    assert not torch.equal(before[name], agent.weights[name])
    torch.testing.assert_close(agent.weights[f"target_{name}"], moved.detach())
