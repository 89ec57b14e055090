"""PPO in one file, in CleanRL's style: a vectorised gymnasium env, a network, a loop.

pip install '.[sim]'
python examples/cleanrl_ppo.py --steps 200000
"""

import argparse

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical

import flowrep.envs  # noqa: F401 - registers the streets with gymnasium

GAMMA, LAMBDA, CLIP, EPOCHS, MINIBATCHES = 0.99, 0.95, 0.1, 4, 4
ENTROPY_WEIGHT, VALUE_WEIGHT, MAX_GRAD_NORM, LEARNING_RATE = 0.01, 0.5, 0.5, 2.5e-4


class Agent(nn.Module):
    def __init__(self, channels: int, actions: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, 32, 8, stride=4), nn.ReLU(),
            nn.Conv2d(32, 64, 4, stride=2), nn.ReLU(),
            nn.Conv2d(64, 64, 3, stride=1), nn.ReLU(),
            nn.Flatten(), nn.LazyLinear(512), nn.ReLU(),
        )  # fmt: skip
        self.actor, self.critic = nn.Linear(512, actions), nn.Linear(512, 1)

    def forward(self, seen: Tensor) -> tuple[Categorical, Tensor]:
        hidden = self.body(seen)
        return Categorical(logits=self.actor(hidden)), self.critic(hidden).squeeze(-1)


def collect(
    envs: gym.vector.VectorEnv, agent: Agent, seen: Tensor, ended: Tensor, length: int
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Returns a rollout, [T, N] per name, and the observation and flags after its last step."""
    steps = []
    for _ in range(length):
        with torch.no_grad():
            policy, value = agent(seen)
        action = policy.sample()
        observation, reward, terminated, truncated, _ = envs.step(action.numpy())
        kept = {"seen": seen, "ended": ended, "action": action, "value": value}
        kept |= {"log_prob": policy.log_prob(action), "reward": torch.as_tensor(reward).float()}
        steps.append(kept)
        seen = torch.as_tensor(observation)
        ended = torch.as_tensor(np.logical_or(terminated, truncated)).float()
    return {name: torch.stack([step[name] for step in steps]) for name in steps[0]}, seen, ended


def advantages(rollout: dict[str, Tensor], next_value: Tensor, next_ended: Tensor) -> Tensor:
    """Returns generalised advantages [T, N]."""
    values = torch.cat([rollout["value"], next_value[None]])
    lives = 1 - torch.cat([rollout["ended"][1:], next_ended[None]])
    found, advantage = [], torch.zeros_like(next_value)
    for t in reversed(range(len(lives))):
        delta = rollout["reward"][t] + GAMMA * values[t + 1] * lives[t] - values[t]
        advantage = delta + GAMMA * LAMBDA * lives[t] * advantage
        found.append(advantage)
    return torch.stack(found[::-1])


def update(agent: Agent, optimizer: torch.optim.Optimizer, batch: dict[str, Tensor]) -> float:
    """Trains for several epochs on one rollout; returns the last loss."""
    for _ in range(EPOCHS):
        for picked in torch.randperm(len(batch["action"])).chunk(MINIBATCHES):
            part = {name: values[picked] for name, values in batch.items()}
            # The step after an episode's end only resets the env; gymnasium ignores its action.
            counts = 1 - part["ended"]
            policy, value = agent(part["seen"])
            ratio = (policy.log_prob(part["action"]) - part["log_prob"]).exp()
            gain = part["advantage"]
            surrogate = torch.minimum(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain)
            value_error = (value - part["return"]).square()
            losses = (
                VALUE_WEIGHT * value_error - surrogate - ENTROPY_WEIGHT * policy.entropy()
            ) * counts
            loss = losses.sum() / counts.sum().clamp(min=1)
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), MAX_GRAD_NORM)
            optimizer.step()
    return loss.item()


def train(steps: int, num_envs: int = 4, rollout_length: int = 128, seed: int = 0) -> Agent:
    """Returns the trained agent."""
    torch.manual_seed(seed)
    envs = gym.make_vec(
        "flowrep/StraightRoad-v0", num_envs=num_envs, representations=["ego", "obj"]
    )
    observation, _ = envs.reset(seed=seed)
    seen, ended = torch.as_tensor(observation), torch.zeros(num_envs)
    agent = Agent(seen.shape[1], int(envs.single_action_space.n))
    agent(seen)  # the first call sets the size of the lazy layer
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    for done in range(0, steps, num_envs * rollout_length):
        rollout, seen, ended = collect(envs, agent, seen, ended, rollout_length)
        with torch.no_grad():
            gain = advantages(rollout, agent(seen)[1], ended)
        rollout["return"] = gain + rollout["value"]
        rollout["advantage"] = (gain - gain.mean()) / (gain.std() + 1e-8)
        batch = {name: values.flatten(0, 1) for name, values in rollout.items()}
        loss = update(agent, optimizer, batch)
        print(f"{done + num_envs * rollout_length} steps, loss {loss:.3f}")
    envs.close()
    return agent


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.save(train(args.steps, seed=args.seed).state_dict(), "cleanrl_ppo.pt")
