import math

import pytest
import torch
from torchrl.data import Binary, Categorical, Composite, OneHot, Unbounded

from flowrep.agent import load_checkpoint, save_checkpoint


def weights(agent):
    return {name: w.clone() for name, w in agent.state_dict()["weights"].items()}


def test_the_learning_rate_falls_linearly_to_zero(make_agent, random_steps, as_batch):
    # (1000 frames - 16 before learning) // 10 = 98 updates
    agent = make_agent(total_frames=1000, batch_size=16, frames_per_update=10, learning_rate=0.98)
    assert agent.total_updates == 98
    batch = as_batch(agent, random_steps(4))
    assert agent.update(batch)["learning_rate"] == pytest.approx(0.98)
    agent.updates = 49
    assert agent.update(batch)["learning_rate"] == pytest.approx(0.49)
    agent.updates = 98
    before = weights(agent)
    assert agent.update(batch)["learning_rate"] == 0
    trained = agent.trained.keys()
    assert all(torch.equal(before[name], weights(agent)[name]) for name in trained)


def test_metrics_are_detached_and_named(make_agent, random_steps, as_batch):
    agent = make_agent()
    metrics = agent.update(as_batch(agent, random_steps(8)))
    assert sorted(metrics.keys()) == [
        "actor_loss", "alpha", "alpha_loss", "entropy", "grad_norm", "learning_rate", "q_loss",
        "q_mean", "td_error",
    ]  # fmt: skip
    assert not any(value.requires_grad for value in metrics.values())
    assert metrics["alpha"] == pytest.approx(0.5)
    assert 0 < metrics["entropy"] <= math.log(3) + 1e-6
    gradients = torch.cat([weight.grad.flatten() for weight in agent.trained.values()])
    assert metrics["grad_norm"] == pytest.approx(gradients.norm().item(), rel=1e-5)


def test_alpha_is_trained_toward_the_target_entropy(make_agent, random_steps, as_batch):
    # a new policy is nearly uniform: entropy log 3, far above 0.2 log 3, so alpha has to fall
    agent = make_agent(learning_rate=0.01)
    batch = as_batch(agent, random_steps(8))
    alphas = [agent.update(batch)["alpha"].item() for _ in range(4)]
    assert alphas == sorted(alphas, reverse=True)
    # Adam's first step is the learning rate itself, on log alpha
    assert alphas[1] == pytest.approx(0.5 * math.exp(-0.01), rel=1e-5)


@pytest.mark.parametrize(("encoder", "moved_by_actor"), [("shared", False), ("separate", True)])
def test_which_encoder_the_policy_loss_reaches(
    make_agent, random_steps, as_batch, encoder, moved_by_actor
):
    agent = make_agent(encoder=encoder)
    agent.losses(as_batch(agent, random_steps(8)))["actor_loss"].backward()
    for name, weight in agent.trained.items():
        if name.startswith("critic_encoder") or name.startswith("qvalue"):
            assert weight.grad is None or not weight.grad.any(), name
        elif name.startswith("actor"):
            assert weight.grad.any(), name
    assert any(n.startswith("actor_encoder") for n in agent.trained) == moved_by_actor


def test_truncated_is_not_terminated(make_agent, random_steps, as_batch):
    """What lies after a truncated step still counts; after a terminated one it does not."""
    agent = make_agent()
    steps = random_steps(8)
    steps["next", "terminated"] = torch.zeros(8, 1, dtype=torch.bool)
    losses = []
    for done in (False, True):
        steps["next", "done"] = torch.full((8, 1), done)
        losses.append(agent.losses(as_batch(agent, steps))["q_loss"].item())
    assert losses[0] == losses[1]
    steps["next", "terminated"] = torch.ones(8, 1, dtype=torch.bool)
    assert agent.losses(as_batch(agent, steps))["q_loss"].item() != losses[0]


def test_bfloat16_stays_near_float32(make_agent, random_steps, as_batch):
    steps = random_steps(64)
    losses = {}
    for precision in ("fp32", "bf16"):
        agent = make_agent(precision=precision)
        losses[precision] = agent.losses(as_batch(agent, steps))
    for name in ("q_loss", "actor_loss", "alpha_loss", "entropy"):
        torch.testing.assert_close(
            losses["bf16"][name].detach(), losses["fp32"][name].detach(), rtol=0.02, atol=2e-3
        )


def test_one_hot_actions_learn_what_categorical_ones_do(make_agent, random_steps, as_batch):
    steps = random_steps(8)
    agent = make_agent()
    expected = agent.losses(as_batch(agent, steps))["q_loss"]
    agent = make_agent(action_spec=OneHot(3))
    steps["action"] = torch.nn.functional.one_hot(steps["action"], 3)
    torch.testing.assert_close(agent.losses(as_batch(agent, steps))["q_loss"], expected)


@pytest.mark.slow_after_first
@pytest.mark.parametrize("encoder", ["shared", "separate"])
def test_a_resumed_agent_equals_an_uninterrupted_one_bit_for_bit(
    make_agent, random_steps, tmp_path, encoder
):
    def learn(agent, seed):
        torch.manual_seed(seed)
        metrics = []
        for _ in range(3):
            agent.memory.extend(random_steps(12))
            metrics += [agent.update(agent.memory.sample()) for _ in range(2)]
        return metrics

    whole = make_agent(encoder=encoder, replay_capacity=40)
    learn(whole, seed=1)
    save_checkpoint(
        tmp_path / "c.safetensors",
        {"agent": whole.state_dict(), "replay": whole.memory.state_dict()},
    )
    expected = learn(whole, seed=2)

    resumed = make_agent(encoder=encoder, replay_capacity=40, seed=9)
    state = load_checkpoint(tmp_path / "c.safetensors")
    resumed.load_state_dict(state["agent"])
    resumed.memory.load_state_dict(state["replay"])
    actual = learn(resumed, seed=2)

    for a, b in zip(expected, actual):
        assert all(torch.equal(a[name], b[name]) for name in a.keys())  # noqa: SIM118
    expected, actual = weights(whole), weights(resumed)
    assert actual["log_alpha"] != math.log(0.5)
    assert all(torch.equal(expected[name], actual[name]) for name in expected)


def test_a_state_of_other_maps_is_refused_with_the_first_difference(make_agent):
    saved = make_agent(keys=["flow"]).state_dict()
    with pytest.raises(ValueError, match=r"\(32, 1024\) here, \(32, 512\) there"):
        make_agent(keys=["flow", "seg"]).load_state_dict(saved)


def test_settings_that_do_not_exist_are_refused(make_agent):
    with pytest.raises(ValueError, match="encoder='both': expected one of shared, separate"):
        make_agent(encoder="both")
    with pytest.raises(ValueError, match="precision='fp16': expected one of auto, bf16, fp32"):
        make_agent(precision="fp16")
    with pytest.raises(TypeError, match="Categorical or OneHot action spec, got Binary"):
        make_agent(action_spec=Binary(3))


def corridor(size):
    """Random steps in a corridor of five cells; the cell is a bright column of the image.

    Action 2 goes right, 1 left, 0 stays; reaching cell 4 ends the episode with 1.
    """
    cell = torch.randint(4, (size,))
    action = torch.randint(3, (size,))
    following = (cell + torch.tensor([0, -1, 1])[action]).clamp(0)
    return cell, action, following, following == 4


def picture(cell):
    image = torch.zeros(len(cell), 1, 36, 40)
    for i, c in enumerate(cell):
        image[i, :, :, c * 8 : c * 8 + 8] = 1.0
    return image


@pytest.mark.slow
@pytest.mark.parametrize("encoder", ["shared", "separate"])
def test_learns_to_walk_to_the_end_of_a_corridor(make_agent, as_batch, encoder):
    spec = Composite(view=Unbounded((1, 36, 40)))
    agent = make_agent(
        spec, ["view"], Categorical(3), encoder=encoder, gamma=0.5, tau=0.1, learning_rate=1e-3,
        initial_alpha=0.01, total_frames=100_000,
    )  # fmt: skip
    for _ in range(100):
        cell, action, following, reached = corridor(32)
        steps = Composite(view=Unbounded((1, 36, 40))).zero([32])
        steps.update({"view": picture(cell), "action": action})
        steps["next"] = steps.select("view").update({"view": picture(following)})
        steps["next", "reward"] = reached.float().unsqueeze(1)
        steps["next", "terminated"] = steps["next", "done"] = reached.unsqueeze(1)
        agent.update(as_batch(agent, steps))
    seen = Composite(view=Unbounded((1, 36, 40))).zero([4])
    seen["view"] = picture(torch.arange(4))
    dist = agent.policy.get_dist(seen)
    assert dist.probs.argmax(1).tolist() == [2, 2, 2, 2]
    critic = agent.loss.qvalue_network
    with torch.no_grad(), agent.loss.qvalue_network_params[0].to_module(critic):
        packed = agent.codecs[0].pack(seen["view"]).movedim(-1, 1)
        q = critic.module(agent.loss.critic_encoder([packed]))
    # going right is worth gamma to the power of the cells left to go: 0.125, 0.25, 0.5, 1
    torch.testing.assert_close(q[:, 2], torch.tensor([0.125, 0.25, 0.5, 1.0]), atol=0.1, rtol=0)
