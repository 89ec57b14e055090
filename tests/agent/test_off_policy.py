"""Persistent exploration: random actions that environments repeat while they collect."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical, OneHot

from flowrep.agent.networks import DiscreteActions
from flowrep.agent.off_policy import PersistentExploration

ACTIONS = DiscreteActions.from_spec(Categorical(3))


def explorer(epsilon, envs, total_frames=10**9, actions=ACTIONS):
    torch.manual_seed(0)
    return PersistentExploration(epsilon, total_frames, envs, actions, torch.device("cpu"))


def acted(action, is_init=None):
    """Environments whose policy chose `action`; an episode begins where `is_init`."""
    is_init = torch.zeros(len(action), dtype=torch.bool) if is_init is None else is_init
    return TensorDict({"action": action, "is_init": is_init.unsqueeze(1)}, [len(action)])


def test_a_drawn_action_is_repeated_for_a_length_of_the_zeta_distribution():
    envs = 20_000
    explore, nine = explorer(1.0, envs), torch.full((envs,), 9)  # no action of the policy
    first = explore(acted(nine.clone()))["action"]
    left = explore.state["steps_left"].clone()
    assert torch.bincount(first).tolist() == pytest.approx([envs / 3] * 3, abs=300)
    lengths = torch.bincount(left + 1, minlength=25)[1:] / envs
    # 6 / π² / n², and the longest stands for all that are longer; five deviations are 0.018
    weights = [6 / math.pi**2 / n**2 for n in range(1, 24)]
    expected = torch.tensor([*weights, 1 - sum(weights)])
    torch.testing.assert_close(lengths, expected, atol=0.018, rtol=0)
    explore.epsilon = 0.0
    for step in range(1, 25):
        action = explore(acted(nine.clone()))["action"]
        assert torch.equal(action, torch.where(left >= step, first, nine))


def test_environments_explore_with_a_probability_that_falls_to_zero_with_the_frames():
    envs = 10_000
    explore, nine = explorer(0.5, envs, total_frames=4 * envs), torch.full((envs,), 9)
    for step in range(4):
        explore.state["steps_left"].zero_()
        share = (explore(acted(nine.clone()))["action"] != 9).float().mean().item()
        assert share == pytest.approx(0.5 * (1 - step / 4), abs=0.02)
    explore.state["steps_left"].zero_()
    assert torch.equal(explore(acted(nine.clone()))["action"], nine)


def test_an_episode_that_begins_forgets_the_action_of_the_last_one():
    explore = explorer(0.0, 4)
    explore.state["steps_left"].fill_(5)
    begins = torch.tensor([True, False, True, False])
    action = explore(acted(torch.full((4,), 2), begins))["action"]
    assert action.tolist() == [2, 0, 2, 0]
    assert explore.state["steps_left"].tolist() == [0, 4, 0, 4]


def test_one_hot_actions_stay_one_hot():
    explore = explorer(0.0, 2, actions=DiscreteActions.from_spec(OneHot(3)))
    explore.state["steps_left"][1] = 3
    explore.state["repeated_action"].fill_(1)
    action = explore(acted(torch.tensor([[0, 0, 1], [0, 0, 1]])))["action"]
    assert action.tolist() == [[0, 0, 1], [0, 1, 0]]


def test_an_agent_acts_so_while_it_collects_and_goes_on_after_a_restart(make_agent, random_maps):
    maps = random_maps(5)
    maps["is_init"] = torch.zeros(5, 1, dtype=torch.bool)

    def drive(act):
        torch.manual_seed(4)
        return torch.stack([act(maps.copy())["action"] for _ in range(10)])

    plain = make_agent()
    assert torch.equal(drive(plain.act), drive(plain.policy))
    agent = make_agent(persistent_exploration=0.9, total_frames=10**6)
    assert not torch.equal(drive(agent.act), drive(agent.policy))
    state = copy.deepcopy(agent.state_dict())
    collected = drive(agent.act)
    drive(agent.act)
    agent.load_state_dict(state)
    assert torch.equal(drive(agent.act), collected)
