import pytest
import torch

from flowrep.agent import DoubleDQN


def test_epsilon_falls_linearly_over_its_share_of_the_frames(make_agent, random_steps):
    # from 1 to 0.1 over 200 frames
    agent = make_agent(DoubleDQN, final_epsilon=0.1, replay_capacity=400)
    steps = random_steps(40)
    for expected in (1 - 0.9 * 80 / 200, 1 - 0.9 * 160 / 200, 0.1, 0.1):
        agent.remember(steps)
        agent.remember(steps)
        assert agent.exploration.eps.item() == pytest.approx(expected)


def values(agent, maps, target=False):
    """Q(s, ·) of raw maps."""
    prefix = "target_value_network_params" if target else "value_network_params"
    network = agent.loss.value_network
    packed = maps.empty().update({c.key: c.store(maps[c.key]) for c in agent.codecs})
    with torch.no_grad(), getattr(agent.loss, prefix).to_module(network):
        return network(packed)["action_value"]


def test_the_online_network_chooses_and_the_target_network_values(
    make_agent, random_steps, as_batch
):
    agent, steps = make_agent(DoubleDQN, learning_rate=0.01, gamma=0.5), random_steps(16)
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
