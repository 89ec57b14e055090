import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical, Composite, Unbounded

from flowrep.agent import PPO
from flowrep.config.algorithms import PPOOptions
from tests.agent.test_replay import step as stored_step

ENVS = 2
SPEC = Composite(view=Unbounded((ENVS, 1, 36, 36)), shape=(ENVS,))


def make_ppo(**changes):
    settings = {
        "precision": "fp32", "learning_rate": 1e-3,
        "rollout_length": 4, "epochs": 3, "batch_size": 3, "gamma": 0.5, "gae_lambda": 0.75,
        "clip": 0.2, "value_weight": 0.5, "entropy_weight": 0.01, "max_grad_norm": 0.5,
        "hidden_size": 16,
    }  # fmt: skip
    torch.manual_seed(0)
    options = PPOOptions(**(settings | changes))
    return PPO(SPEC, Categorical(3), ["view"], options, total_frames=600)


def ppo_after_a_rollout(**changes):
    agent = make_ppo(**changes)
    for each in STEPS:
        agent.remember(each)
    return agent


def step(now, later, reward, ended="--"):
    """One step of two environments whose maps show a number; t(erminated), c(ut off) or -."""
    one = stored_step(now, later, ended, action=[1, 2])
    one["next", "reward"] = torch.tensor(reward).unsqueeze(1)
    return one.set("action_log_prob", torch.tensor([-0.5, -0.75]))


STEPS = [
    step([0.125, 1.0], [0.25, 1.125], [1.0, 2.0]),
    step([0.25, 1.125], [0.375, 1.25], [3.0, 4.0], ended="t-"),
    step([0.75, 1.25], [0.875, 1.5], [5.0, 6.0], ended="-c"),
    step([0.875, 2.0], [4.0, 3.0], [7.0, 8.0]),
]


def worth(agent, number):
    """V of a map that shows that number."""
    codec = agent.codecs[0]
    image = codec.decode(codec.store(torch.full((1, 1, 36, 36), number)))
    with torch.no_grad():
        embedded = TensorDict({"embedding": agent.loss.encoder([image])}, [1])
        return agent.loss.critic_network(embedded)["state_value"]


def test_a_complete_rollout_is_learnt_from_in_shuffled_passes_and_then_forgotten():
    agent = make_ppo()
    for t, each in enumerate(STEPS):
        assert agent.updates_due(ENVS * t) == 0
        agent.remember(each)
    # 8 frames make 2 batches of 3, in each of 3 epochs
    assert agent.updates_due(8) == 6
    seen = [agent.sample()["next", "reward"].flatten().tolist() for _ in range(6)]
    passes = [(*first, *second) for first, second in zip(seen[::2], seen[1::2])]
    assert [len({*rewards}) for rewards in passes] == [6, 6, 6]
    assert len({*passes}) == 3  # shuffled: in the order of time, all three would be equal
    assert len(agent.memory) == 0
    assert agent.updates_due(8) == 0
    assert agent.total_updates == 600 // 8 * 6


def test_advantages_are_those_worked_by_hand():
    """Environment 0 terminates in its second step, environment 1 is cut off in its third."""
    agent = ppo_after_a_rollout(batch_size=8, epochs=1)
    agent.weights["critic_network_params.module.output.weight"].data.mul_(10)
    batch = agent.sample()
    steps = batch[batch["next", "reward"].flatten().argsort()]  # rewards count the steps from 1 on
    v = {
        n: worth(agent, n).item()
        for n in (0.125, 0.25, 0.75, 0.875, 4.0, 1.0, 1.125, 1.25, 1.5, 2.0, 3.0)
    }
    # delta = r + 0.5 V' - V; advantage = delta + 0.5 · 0.75 the next one's, within an episode
    a1 = 3 - v[0.25]
    a0 = 1 + 0.5 * v[0.25] - v[0.125] + 0.375 * a1
    a3 = 7 + 0.5 * v[4.0] - v[0.875]
    a2 = 5 + 0.5 * v[0.875] - v[0.75] + 0.375 * a3
    b2 = 6 + 0.5 * v[1.5] - v[1.25]
    b1 = 4 + 0.5 * v[1.25] - v[1.125] + 0.375 * b2
    b0 = 2 + 0.5 * v[1.125] - v[1.0] + 0.375 * b1
    b3 = 8 + 0.5 * v[3.0] - v[2.0]
    expected = torch.tensor([a0, b0, a1, b1, a2, b2, a3, b3])
    advantage = steps["advantage"].squeeze(-1)
    torch.testing.assert_close(advantage, expected)
    target = advantage + steps["state_value"].squeeze(-1)
    torch.testing.assert_close(steps["value_target"].squeeze(-1), target)


def test_a_step_is_weighted_by_how_likely_it_was_under_the_weights_that_acted():
    """The training loop begins the next rollout before it learns from the last one."""
    agent = ppo_after_a_rollout(gamma=0.0, clip=0.9, batch_size=8, epochs=1)
    batch = agent.sample()
    with torch.no_grad():
        image = agent.codecs[0].decode(batch["view"])
        embedded = TensorDict({"embedding": agent.loss.encoder([image])}, [8])
        dist = agent.loss.actor_network.get_dist(embedded)
        now = dist.log_prob(batch["action"])
    then = torch.where(batch["action"] == 1, -0.5, -0.75)
    advantage = batch["advantage"].flatten()
    advantage = (advantage - advantage.mean()) / advantage.std()
    expected = -((now - then).exp() * advantage).mean()
    losses = agent.losses(batch)
    torch.testing.assert_close(losses["policy_loss"], expected, rtol=1e-4, atol=1e-6)
    entropy = dist.entropy().mean().detach()
    torch.testing.assert_close(losses["entropy"], entropy)
    torch.testing.assert_close(losses["entropy_loss"].detach(), -0.01 * entropy)


def test_gradients_are_scaled_down_to_the_largest_norm():
    agent = ppo_after_a_rollout(max_grad_norm=1e-3)
    norm = agent.update(agent.sample())["grad_norm"]
    gradients = torch.cat([w.grad.flatten() for w in agent.trained.values()])
    assert norm > 0.01
    assert gradients.norm().item() == pytest.approx(1e-3, rel=1e-3)


def test_a_batch_larger_than_a_rollout_is_refused():
    with pytest.raises(ValueError, match=r"batch_size=9 is more than the 8 frames of a rollout"):
        make_ppo(batch_size=9)
