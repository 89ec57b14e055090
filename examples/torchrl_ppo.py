"""TorchRL's stock PPO (collector, GAE, ClipPPOLoss) on ego and object flow.

pip install '.[sim]'
python examples/torchrl_ppo.py --steps 200000
"""

import argparse

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import CatTensors, TransformedEnv
from torchrl.modules import (
    MLP,
    ActorValueOperator,
    ConvNet,
    ProbabilisticActor,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from flowrep.envs import make_env

EPOCHS, MINIBATCH = 4, 128


def networks(env: TransformedEnv) -> ActorValueOperator:
    """Returns an actor and a critic that share a convolutional body."""
    body = nn.Sequential(
        ConvNet(
            num_cells=[32, 64, 64],
            kernel_sizes=[8, 4, 3],
            strides=[4, 2, 1],
            activation_class=nn.ReLU,
        ),
        MLP(out_features=512, num_cells=[], activate_last_layer=True, activation_class=nn.ReLU),
    )
    common = TensorDictModule(body, in_keys=["maps"], out_keys=["hidden"])
    logits = TensorDictModule(nn.Linear(512, 3), in_keys=["hidden"], out_keys=["logits"])
    actor = ProbabilisticActor(
        logits,
        in_keys=["logits"],
        spec=env.action_spec,
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    operator = ActorValueOperator(
        common, actor, ValueOperator(nn.Linear(512, 1), in_keys=["hidden"])
    )
    with torch.no_grad():
        operator(env.reset())  # the first call sets the sizes of the lazy layers
    return operator


def train(steps: int, num_envs: int = 4, rollout_length: int = 128, seed: int = 0) -> nn.Module:
    """Returns the trained policy."""
    torch.manual_seed(seed)
    # TorchRL's transforms can follow flowrep's: this one joins ego and obj along their channels.
    join = CatTensors(["ego", "obj"], "maps", dim=-3, del_keys=False)
    env = make_env("straight_road", ["ego", "obj"], num_envs=num_envs, seed=seed)
    env = env.append_transform(join)
    operator = networks(env)
    policy, critic = operator.get_policy_operator(), operator.get_value_operator()
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    loss_module = ClipPPOLoss(operator.get_policy_head(), operator.get_value_head())
    optimizer = torch.optim.Adam(operator.parameters(), lr=2.5e-4)
    frames = num_envs * rollout_length
    memory = TensorDictReplayBuffer(
        storage=LazyTensorStorage(frames),
        sampler=SamplerWithoutReplacement(),
        batch_size=MINIBATCH,
    )
    for batch in Collector(env, policy, frames_per_batch=frames, total_frames=steps):
        with torch.no_grad():
            advantage(batch)
        for _ in range(EPOCHS):
            memory.extend(batch.reshape(-1))
            for part in memory:
                losses = loss_module(operator.module[0](part))
                loss = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(operator.parameters(), 0.5)
                optimizer.step()
        reward = batch["next", "reward"].mean().item()
        print(f"loss {loss.item():.3f}, reward a step {reward:.3f}")
    return policy


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.save(train(args.steps, seed=args.seed).state_dict(), "torchrl_ppo.pt")
