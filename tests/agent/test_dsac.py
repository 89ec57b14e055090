"""Discrete SAC: its parts by hand, and gradient steps against the same losses in plain float64."""

import math

import pytest
import torch
import torch.nn.functional as F

from flowrep.agent import DiscreteSAC, DiscreteSACWithValue


def test_losses_in_bfloat16_are_near_those_in_float32(make_agent, random_steps, as_batch):
    steps = random_steps(64)
    losses = {}
    for precision in ("fp32", "bf16"):
        agent = make_agent(precision=precision)
        losses[precision] = agent.losses(as_batch(agent, steps))
    for name in ("q_loss", "actor_loss", "alpha_loss", "entropy"):
        torch.testing.assert_close(
            losses["bf16"][name].detach(), losses["fp32"][name].detach(), rtol=0.02, atol=2e-3
        )


LR, ALPHA, GAMMA, TAU, TARGET_ENTROPY = 3e-4, 0.5, 0.99, 0.005, 0.2 * math.log(3)


def encode(weights, prefix, maps):
    """Nature encoders in plain PyTorch, whose weights' names begin with `prefix`."""
    embeddings = []
    for i, x in enumerate(maps):
        w = {k.removeprefix(f"{prefix}.encoders.{i}."): v for k, v in weights.items()}
        x = F.leaky_relu(F.conv2d(x, w["conv1.weight"], w["conv1.bias"], 4))
        x = F.leaky_relu(F.conv2d(x, w["conv2.weight"], w["conv2.bias"], 2))
        x = F.leaky_relu(F.conv2d(x, w["conv3.weight"], w["conv3.bias"]))
        x = x.permute(0, 2, 3, 1).flatten(1)
        embeddings.append(F.leaky_relu(F.linear(x, w["linear.weight"], w["linear.bias"])))
    return torch.cat(embeddings, 1)


def head(weights, prefix, x, net=...):
    """A linear layer, SiLU and a linear layer; of the stacked head `net`."""
    w = {k: weights[f"{prefix}.{k}"][net] for k in
         ("hidden.weight", "hidden.bias", "output.weight", "output.bias")}  # fmt: skip
    x = F.linear(x, w["hidden.weight"], w["hidden.bias"])
    return F.linear(x * torch.sigmoid(x), w["output.weight"], w["output.bias"])


def dsac_losses(weights, maps, next_maps, action, reward, terminated):
    """Losses of Q, actor and α."""
    separate = "actor_encoder_params.encoders.0.conv1.weight" in weights
    actor, critic, target = (
        "actor_network_params.module.0.module",
        "qvalue_network_params.module",
        "target_qvalue_network_params.module",
    )
    alpha = weights["log_alpha"].exp().detach()
    with torch.no_grad():
        embedded = encode(weights, "target_critic_encoder_params", next_maps)
        seen = encode(weights, "actor_encoder_params", next_maps) if separate else embedded
        policy = head(weights, actor, seen).softmax(1)
        q = torch.minimum(*(head(weights, target, embedded, net=i) for i in (0, 1)))
        value = (policy * (q - alpha * policy.log())).sum(1)
        y = reward + GAMMA * torch.where(terminated, 0.0, value)
    embedded = encode(weights, "critic_encoder_params", maps)
    qs = [head(weights, critic, embedded, net=i) for i in (0, 1)]
    chosen = [q[torch.arange(len(q)), action] for q in qs]
    q_loss = sum(((q - y) ** 2).mean() for q in chosen)
    seen = encode(weights, "actor_encoder_params", maps) if separate else embedded.detach()
    policy = head(weights, actor, seen).softmax(1)
    smaller = torch.minimum(*qs).detach()
    actor_loss = (policy * (alpha * policy.log() - smaller)).sum(1).mean()
    negative_entropy = (policy * policy.log()).sum(1).detach()
    alpha_loss = (-weights["log_alpha"] * (negative_entropy + TARGET_ENTROPY)).mean()
    return {"q_loss": q_loss, "actor_loss": actor_loss, "alpha_loss": alpha_loss}


def dsac_v_losses(weights, maps, next_maps, action, reward, terminated):
    """Losses of Q, V, actor and α, of networks that share nothing."""

    def network(name, maps):
        return head(weights, f"{name}_params.head", encode(weights, f"{name}_params.encoder", maps))

    rows, alpha = torch.arange(len(action)), weights["log_alpha"].exp().detach()
    policy = network("actor", maps).softmax(1)
    negative_entropy = (policy * policy.log()).sum(1)
    q1, q2 = network("q1", maps), network("q2", maps)
    y = reward + GAMMA * torch.where(terminated, 0.0, network("target_value", next_maps)[:, 0])
    q_loss = (
        (q1[rows, action] - y.detach()) ** 2 + (q2[rows, action] - y.detach()) ** 2
    ).mean() / 2
    expected = torch.minimum((policy * q1).sum(1), (policy * q2).sum(1))
    value_target = (expected - alpha * negative_entropy).detach()
    value_loss = ((network("value", maps)[:, 0] - value_target) ** 2).mean() / 2
    actor_loss = (alpha * negative_entropy - (policy * q1.detach()).sum(1)).mean()
    alpha_loss = (-weights["log_alpha"] * (negative_entropy.detach() + TARGET_ENTROPY)).mean()
    return {
        "q_loss": q_loss, "value_loss": value_loss, "actor_loss": actor_loss,
        "alpha_loss": alpha_loss,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("algorithm", "options", "reference_losses"),
    [
        (DiscreteSAC, {"encoder": "shared"}, dsac_losses),
        (DiscreteSAC, {"encoder": "separate"}, dsac_losses),
        (DiscreteSACWithValue, {}, dsac_v_losses),
    ],
)
def test_three_updates_equal_those_of_the_losses_in_plain_float64(
    make_agent, random_steps, as_batch, algorithm, options, reference_losses
):
    """Steps that are done without being terminated count like others, as the reference has it."""
    agent = make_agent(algorithm, initial_alpha=ALPHA, gamma=GAMMA, tau=TAU, **options)
    steps = random_steps(16)
    batch = as_batch(agent, steps)
    batch["next", "done"] = torch.ones_like(batch["next", "done"])
    weights = {n: w.double().clone() for n, w in agent.state_dict()["weights"].items()}
    trained = [n for n, w in weights.items() if not n.startswith("target")]
    assert sorted(trained) == sorted(agent.trained)
    for name in trained:
        weights[name].requires_grad_()

    def plain(maps):
        one_hot = F.one_hot(maps["seg"].squeeze(1).long(), 4).movedim(-1, 1)
        return maps["flow"].double(), one_hot.double()

    optimizer = torch.optim.Adam([weights[n] for n in trained], lr=LR)
    for update in range(3):
        losses = reference_losses(
            weights, plain(steps), plain(steps["next"]), steps["action"],
            steps["next", "reward"].double().squeeze(1), steps["next", "terminated"].squeeze(1),
        )  # fmt: skip
        optimizer.zero_grad()
        sum(losses.values()).backward()
        optimizer.param_groups[0]["lr"] = LR * (1 - update / agent.total_updates)
        optimizer.step()
        with torch.no_grad():
            for name in set(weights) - set(trained):
                weights[name] += TAU * (weights[name.removeprefix("target_")] - weights[name])

        metrics = agent.update(batch)
        for name, loss in losses.items():
            torch.testing.assert_close(metrics[name].double(), loss.detach(), rtol=1e-5, atol=1e-6)
        for name, weight in agent.state_dict()["weights"].items():
            # a step is 3e-4; where a gradient is near Adam's epsilon of 1e-8, float32 cannot fix it
            error = (weight.double() - weights[name].detach()).abs()
            assert (error > 3e-6).double().mean() < 1e-3, name
            assert error.max() < LR, name
        for name, weight in agent.trained.items():
            expected = weights[name].grad
            error = (weight.grad.double() - expected).abs().max()
            # after the first update the weights themselves differ, as said above
            tolerance = 1e-5 if update == 0 else 1e-3
            assert error <= tolerance * expected.abs().max(), name
    assert agent.updates == 3
