"""One gradient step against the same losses written plainly, in float64."""

import math

import pytest
import torch
import torch.nn.functional as F

LR, ALPHA, GAMMA, TAU, TARGET_ENTROPY = 3e-4, 0.5, 0.99, 0.005, 0.2 * math.log(3)


def encode(weights, prefix, maps):
    """Nature encoders on plain maps, concatenated."""
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
    w = {k: weights[f"{prefix}.{k}"][net] for k in
         ("hidden.weight", "hidden.bias", "output.weight", "output.bias")}  # fmt: skip
    x = F.linear(x, w["hidden.weight"], w["hidden.bias"])
    return F.linear(x * torch.sigmoid(x), w["output.weight"], w["output.bias"])


def reference_losses(weights, separate, maps, next_maps, action, reward, terminated):
    """Losses of Q, actor and α."""
    actor, critic, target = (
        "actor_network_params.module.0.module",
        "qvalue_network_params.module",
        "target_qvalue_network_params.module",
    )
    alpha = weights["log_alpha"].exp().detach()
    actor_encoder = "actor_encoder" if separate else "critic_encoder"
    with torch.no_grad():
        policy = head(weights, actor, encode(weights, actor_encoder, next_maps)).softmax(1)
        embedded = encode(weights, "target_encoder", next_maps)
        q = torch.minimum(*(head(weights, target, embedded, net=i) for i in (0, 1)))
        value = (policy * (q - alpha * policy.log())).sum(1)
        y = reward + GAMMA * torch.where(terminated, 0.0, value)
    embedded = encode(weights, "critic_encoder", maps)
    qs = [head(weights, critic, embedded, net=i) for i in (0, 1)]
    chosen = [q[torch.arange(len(q)), action] for q in qs]
    q_loss = sum(((q - y) ** 2).mean() for q in chosen)
    seen = encode(weights, "actor_encoder", maps) if separate else embedded.detach()
    policy = head(weights, actor, seen).softmax(1)
    smaller = torch.minimum(*qs).detach()
    actor_loss = (policy * (alpha * policy.log() - smaller)).sum(1).mean()
    negative_entropy = (policy * policy.log()).sum(1).detach()
    alpha_loss = (-weights["log_alpha"] * (negative_entropy + TARGET_ENTROPY)).mean()
    return q_loss, actor_loss, alpha_loss


@pytest.mark.parametrize("encoder", ["shared", "separate"])
def test_an_update_equals_the_plain_float64_one(make_agent, random_steps, as_batch, encoder):
    agent = make_agent(encoder=encoder, initial_alpha=ALPHA, gamma=GAMMA, tau=TAU)
    steps = random_steps(16)
    separate = encoder == "separate"
    weights = {n: w.double().clone() for n, w in agent.state_dict()["weights"].items()}
    trained = [n for n, w in weights.items() if not n.startswith("target")]
    for name in trained:
        weights[name].requires_grad_()

    def plain(maps):
        one_hot = F.one_hot(maps["seg"].squeeze(1).long(), 4).movedim(-1, 1)
        return maps["flow"].double(), one_hot.double()

    optimizer = torch.optim.Adam([weights[n] for n in trained], lr=LR)
    batch = as_batch(agent, steps)
    for update in range(3):
        losses = reference_losses(
            weights, separate, plain(steps), plain(steps["next"]), steps["action"],
            steps["next", "reward"].double().squeeze(1), steps["next", "terminated"].squeeze(1),
        )  # fmt: skip
        optimizer.zero_grad()
        sum(losses).backward()
        optimizer.param_groups[0]["lr"] = LR * (1 - update / agent.total_updates)
        optimizer.step()
        with torch.no_grad():
            for name in set(weights) - set(trained):
                online = name.replace("target_encoder", "critic_encoder").removeprefix("target_")
                weights[name] += TAU * (weights[online] - weights[name])

        metrics = agent.update(batch)
        for name, loss in zip(("q_loss", "actor_loss", "alpha_loss"), losses):
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
