"""What holds for every algorithm of conf/algorithm/."""

import copy
import math

import pytest
import torch
from torchrl.data import Categorical, OneHot
from torchrl.envs.utils import ExplorationType, set_exploration_type

from flowrep.agent import DivergenceError, load_checkpoint, save_checkpoint

ENVS = 5


def learn(agent, random_steps, steps, frames=0):
    """Takes in so many steps of five environments, with the updates that they bring."""
    metrics = []
    for _ in range(steps):
        agent.remember(random_steps(ENVS))
        frames += ENVS
        metrics += [agent.update(agent.sample()) for _ in range(agent.updates_due(frames))]
    return metrics


def weights(agent):
    return {name: w.clone() for name, w in agent.state_dict()["weights"].items()}


def test_an_update_returns_what_it_says_it_does(make_any, random_steps):
    agent = make_any()
    (*_, last) = learn(agent, random_steps, 12)
    assert tuple(sorted(last)) == tuple(sorted(agent.metric_names()))
    assert all(value.shape == () and not value.requires_grad for value in last.values())
    assert all(value.isfinite() for name, value in last.items() if name != "explained_variance")
    assert agent.updates > 0


@pytest.mark.slow_after_first
def test_pixels_without_a_class_are_acted_on_and_learnt_from(make_any, random_steps):
    agent = make_any()

    def partly_seen(size):
        steps = random_steps(size)
        for maps in (steps, steps["next"]):
            maps["seg"][..., 3:9] = 255
        return agent.policy(steps)

    (*_, last) = learn(agent, partly_seen, 12)
    assert last["grad_norm"].isfinite()


@pytest.mark.slow_after_first
def test_every_trained_weight_moves(make_any, random_steps):
    agent = make_any()
    before = weights(agent)
    learn(agent, random_steps, 20)
    still = [n for n, w in weights(agent).items() if torch.equal(w, before[n])]
    assert still == []


def test_a_transition_of_three_steps_is_discounted_three_times(make_any, random_steps, as_batch):
    agent, cubed = make_any(gamma=0.5), make_any(gamma=0.5**3)
    if not hasattr(agent, "frames_per_update"):
        pytest.skip("learns from whole rollouts")
    steps = random_steps(16)
    batch, once = as_batch(agent, steps), as_batch(agent, steps)
    batch["steps_to_next_obs"] = torch.full((16, 1), 3.0)
    loss, expected = agent.losses(batch)["q_loss"], cubed.losses(once)["q_loss"]
    torch.testing.assert_close(loss, expected)
    assert not torch.isclose(loss, agent.losses(once)["q_loss"])


@pytest.mark.slow_after_first
def test_the_learning_rate_ends_at_zero_with_the_frames(make_any, random_steps):
    agent = make_any(total_frames=200, learning_rate=2**-10)
    metrics = learn(agent, random_steps, 40)
    rates = [m["learning_rate"].item() for m in metrics]
    assert len(rates) == agent.total_updates
    assert rates[0] == 2**-10
    assert rates[-1] == pytest.approx(2**-10 / len(rates))


@pytest.mark.parametrize(
    ("name", "frames_before", "frames_after", "due"),
    [
        ("off-policy, in its first batch", 0, 16, 0),
        ("one for each 10 frames after it", 0, 25, 0),
        ("one for each 10 frames after it", 0, 26, 1),
        ("counted beyond those taken", 40, 66, 3),
    ],
)
def test_off_policy_updates_due(make_agent, name, frames_before, frames_after, due):
    agent = make_agent(batch_size=16, frames_per_update=10)
    agent.updates = agent.updates_due(frames_before)
    assert agent.updates_due(frames_after) == due, name


@pytest.mark.slow_after_first
@pytest.mark.parametrize("steps", [5, 13])  # an on-policy rollout of 8 is cut in its middle
def test_a_resumed_agent_equals_an_uninterrupted_one_bit_for_bit(
    make_any, random_steps, tmp_path, steps
):
    def go_on(agent):
        torch.manual_seed(2)
        return learn(agent, random_steps, 12, frames=steps * ENVS)

    whole = make_any()
    learn(whole, random_steps, steps)
    saved = {"agent": whole.state_dict(), "memory": whole.memory.state_dict()}
    save_checkpoint(tmp_path / "c", saved)
    expected = go_on(whole)

    resumed = make_any(seed=9)
    state = load_checkpoint(tmp_path / "c")
    resumed.load_state_dict(state["agent"])
    resumed.memory.load_state_dict(state["memory"])
    actual = go_on(resumed)
    assert len(expected) == len(actual) > 0
    for a, b in zip(expected, actual):
        assert all(torch.equal(a[name].nan_to_num(7), b[name].nan_to_num(7)) for name in a)
    a, b = weights(whole), weights(resumed)
    assert [name for name in a if not torch.equal(a[name], b[name])] == []


@pytest.mark.slow_after_first
@pytest.mark.parametrize("before", [0, 2], ids=["before any update", "after two"])
def test_a_used_agent_that_is_loaded_equals_a_new_one_bit_for_bit(make_any, random_steps, before):
    used, new = make_any(learning_rate=0.01), make_any(learning_rate=0.01, seed=9)
    for _ in range(12):
        used.remember(random_steps(ENVS))
    batches = [used.sample() for _ in range(before + 4)]
    for batch in batches[:before]:
        used.update(batch.clone())
    state = copy.deepcopy(used.state_dict())
    for batch in batches:
        used.update(batch.clone())
    spoilt = batches[0].clone()
    for key in (("next", "reward"), "advantage", "value_target"):
        if key in spoilt.keys(True):
            spoilt[key] = torch.full_like(spoilt[key], torch.nan)
    used.update(spoilt.clone())
    with pytest.raises(DivergenceError, match=rf"in update {2 * before + 5} "):
        used.divergence.check()
    for agent in (used, new):
        agent.load_state_dict(state)
        for batch in batches[before:]:
            agent.update(batch.clone())
        agent.divergence.check()
    a, b = weights(used), weights(new)
    assert [name for name in a if not torch.equal(a[name], b[name])] == []
    used.update(spoilt)
    with pytest.raises(DivergenceError, match=rf"in update {before + 5} "):
        used.divergence.check()


@pytest.mark.slow_after_first
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_loss_that_is_no_number_stops_the_weights_and_is_named(make_any, random_steps, bad):
    agent = make_any()
    learn(agent, random_steps, 12)
    agent.divergence.check()
    before, updates = weights(agent), agent.updates
    rewards = random_steps(ENVS)
    rewards["next", "reward"] = torch.full((ENVS, 1), bad)
    rewards["next", "terminated"] = torch.ones(ENVS, 1, dtype=torch.bool)
    for _ in range(16):
        agent.remember(rewards)
    for _ in range(3):
        agent.update(agent.sample())
    moved = {n for n, w in weights(agent).items() if not torch.equal(w, before[n])}
    assert not moved & agent.trained.keys()
    with pytest.raises(DivergenceError, match=rf"_loss became (nan|inf) in update {updates + 1} "):
        agent.divergence.check()


def test_where_nothing_is_observed_nothing_is_done(make_any, random_maps):
    agent = make_any()
    for maps in (random_maps(4)[:0], random_maps(2, 3)[:, :0]):
        with torch.no_grad():
            assert agent.policy.get_dist(maps.clone()).probs.shape == (*maps.shape, 3)
            assert agent.policy(maps)["action"].shape == maps.shape


def test_acts_greedily_only_when_told_to(make_any, random_maps):
    agent, maps = make_any(), random_maps(1).expand(300).contiguous()
    with torch.no_grad():
        drawn = agent.policy(maps.clone())["action"]
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            greedy = agent.policy(maps.clone())["action"]
    assert len(drawn.unique()) == 3
    assert len(greedy.unique()) == 1


def test_one_hot_actions_are_learnt_from_as_well(make_any, random_steps):
    agent = make_any(action_spec=OneHot(3))

    def one_hot(size):
        steps = random_steps(size)
        steps["action"] = torch.nn.functional.one_hot(steps["action"], 3)
        return steps

    assert learn(agent, one_hot, 12)


def test_a_state_of_other_maps_is_refused_by_name(make_any):
    saved = make_any(keys=["flow"]).state_dict()
    with pytest.raises(ValueError, match=r"does not fit this one in \d+ weights, first .* here, "):
        make_any(keys=["flow", "seg"]).load_state_dict(saved)


@pytest.mark.parametrize("changes", [{}, {"layer_norm": True}], ids=["as is", "layer norm"])
def test_a_policy_is_built_and_loaded_without_its_learner(
    make_any, observation_spec, random_steps, random_maps, tmp_path, changes
):
    """Of one environment, too, where a rollout would be less than a batch of PPO's."""
    agent = make_any(**changes)
    learn(agent, random_steps, 12)
    save_checkpoint(tmp_path / "c", {"policy": dict(agent.policy.state_dict())})
    options = make_any.options | {"total_frames": 1000}
    options |= {name: value for name, value in changes.items() if name in options}
    policy = type(agent).make_policy(
        observation_spec[:1], Categorical(3), ["flow", "seg"], device="cpu", **options
    )
    maps = random_maps(20)
    with torch.no_grad():
        expected = agent.policy.get_dist(maps.clone()).probs
        assert not torch.equal(policy.get_dist(maps.clone()).probs, expected)
        policy.load_state_dict(load_checkpoint(tmp_path / "c")["policy"])
        assert torch.equal(policy.get_dist(maps.clone()).probs, expected)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            greedy = agent.policy(maps.clone())["action"]
            assert torch.equal(policy(maps.clone())["action"], greedy)
        assert torch.equal(expected.argmax(-1), greedy)


@pytest.mark.slow_after_first
def test_actions_are_drawn_as_the_distribution_says(make_any, random_steps, random_maps):
    agent = make_any()
    learn(agent, random_steps, 12)
    maps = random_maps(1)
    with torch.no_grad():
        expected = agent.policy.get_dist(maps.clone()).probs[0]
        drawn = agent.policy(maps.expand(3000).contiguous())["action"]
    # three standard deviations of a share are 0.027
    shares = torch.bincount(drawn, minlength=3) / 3000
    torch.testing.assert_close(shares, expected, atol=0.03, rtol=0)
