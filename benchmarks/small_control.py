"""Return on a small control problem: flowrep's discrete SAC beside TorchRL's stock recipe.

A ball falls through a picture of 36 x 36 pixels in eight steps, and a paddle at the bottom goes
left, stays or goes right. Each step that it ends below the ball gives a reward of 1/8. Both
learners have the same pictures, networks, batch, replay size, learning rate and number of updates.

    python benchmarks/small_control.py --seeds 3 --frames 12000
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import InteractionType, ProbabilisticTensorDictModule, TensorDictModule
from tensordict.nn import ProbabilisticTensorDictSequential as Sequential
from torch import nn
from torchrl.data import (
    Categorical,
    Composite,
    LazyTensorStorage,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import EnvBase, InitTracker, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import DiscreteSACLoss, SoftUpdate

from flowrep.agent import DiscreteSAC, keep_freed_memory
from flowrep.agent.observation import has_fast_bf16

CELLS, PIXELS, ENVS = 9, 4, 16
SIDE = CELLS * PIXELS
BATCH, FRAMES_PER_UPDATE, LEARNING_RATE, GAMMA, TAU = 64, 16, 1e-3, 0.9, 0.05
REPLAY, HIDDEN, ALPHA, TARGET_ENTROPY_WEIGHT = 4096, 64, 0.02, 0.1
# A paddle d cells away is below the ball in its dth step and those after it, all eight for d = 0.
DISTANCES = [abs(i - j) for i in range(CELLS) for j in range(CELLS)]
BEST = statistics.mean((CELLS - max(1, d)) / (CELLS - 1) for d in DISTANCES)


class Follow(EnvBase):
    """A batch of games."""

    def __init__(self, envs: int = ENVS) -> None:
        super().__init__(batch_size=[envs])
        self.observation_spec = Composite(view=Unbounded((envs, 1, SIDE, SIDE)), shape=(envs,))
        self.action_spec = Categorical(3, shape=(envs,))
        self.reward_spec = Unbounded((envs, 1))
        self.ball, self.row, self.paddle = (torch.zeros(envs, dtype=torch.long) for _ in range(3))

    def _view(self) -> torch.Tensor:
        picture = torch.zeros(len(self.ball), 1, CELLS, CELLS)
        games = torch.arange(len(self.ball))
        picture[games, 0, self.row, self.ball] = 1.0
        picture[games, 0, -1, self.paddle] = 0.5
        return picture.repeat_interleave(PIXELS, -1).repeat_interleave(PIXELS, -2)

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        anew = torch.ones(len(self.ball), dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            anew = tensordict["_reset"].reshape(-1)
        self.ball = torch.where(anew, torch.randint(CELLS, self.ball.shape), self.ball)
        self.paddle = torch.where(anew, torch.randint(CELLS, self.ball.shape), self.paddle)
        self.row = torch.where(anew, 0, self.row)
        return TensorDict({"view": self._view()}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.paddle = (self.paddle + tensordict["action"] - 1).clamp(0, CELLS - 1)
        self.row = self.row + 1
        done = self.row == CELLS - 1
        below = (self.ball == self.paddle).float()
        outcome = {
            "view": self._view(),
            "reward": below.unsqueeze(1) / (CELLS - 1),
            "done": done.unsqueeze(1),
            "terminated": done.unsqueeze(1),
        }
        return TensorDict(outcome, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        pass


Policy = Callable[[TensorDictBase], TensorDictBase]
Learner = tuple[Policy, Callable[[TensorDictBase], object], Callable[[], object]]


def flowrep_learner(
    env: EnvBase, frames: int, precision: str = "fp32", encoder: str = "separate"
) -> Learner:
    """Returns a policy, a function that stores steps, and one that makes an update."""
    agent = DiscreteSAC(
        env.observation_spec, env.action_spec, ["view"], total_frames=frames, device="cpu",
        encoder=encoder, precision=precision, learning_rate=LEARNING_RATE, initial_alpha=ALPHA,
        target_entropy_weight=TARGET_ENTROPY_WEIGHT, gamma=GAMMA, tau=TAU, hidden_size=HIDDEN,
        batch_size=BATCH, replay_capacity=REPLAY, frames_per_update=FRAMES_PER_UPDATE,
        learning_starts=None,
    )  # fmt: skip
    return agent.policy, agent.remember, lambda: agent.update(agent.sample())


def plain_network() -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(1, 32, 8, 4), nn.LeakyReLU(), nn.Conv2d(32, 64, 4, 2), nn.LeakyReLU(),
        nn.Conv2d(64, 64, 3), nn.LeakyReLU(), nn.Flatten(-3), nn.Linear(64, 512), nn.LeakyReLU(),
        nn.Linear(512, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, 3),
    )  # fmt: skip


def stock_learner(env: EnvBase, frames: int) -> Learner:
    """Returns a learner of TorchRL's loss, replay buffer and Adam, combined as in its examples."""
    actor = Sequential(
        TensorDictModule(plain_network(), ["view"], ["logits"]),
        ProbabilisticTensorDictModule(
            in_keys=["logits"],
            out_keys=["action"],
            distribution_class=torch.distributions.Categorical,
            default_interaction_type=InteractionType.RANDOM,
        ),
    )
    critic = TensorDictModule(plain_network(), ["view"], ["action_value"])
    loss = DiscreteSACLoss(
        actor, critic, action_space="categorical", num_actions=3, loss_function="l2",
        alpha_init=ALPHA, target_entropy_weight=TARGET_ENTROPY_WEIGHT,
    )  # fmt: skip
    loss.make_value_estimator(gamma=GAMMA)
    move_targets = SoftUpdate(loss, tau=TAU)
    optimizer = torch.optim.Adam(loss.parameters(), lr=LEARNING_RATE)
    updates = max(1, (frames - BATCH) // FRAMES_PER_UPDATE)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda done: max(0, 1 - done / updates))
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(REPLAY), batch_size=BATCH)

    def update() -> None:
        losses = loss(replay.sample())
        optimizer.zero_grad()
        (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        optimizer.step()
        schedule.step()
        move_targets.step()

    return actor, replay.extend, update


def train(make_learner: Callable[[EnvBase, int], Learner], frames: int, seed: int) -> float:
    """Returns the mean greedy return over 512 games after training on `frames` frames."""
    torch.manual_seed(seed)
    env = TransformedEnv(Follow(), InitTracker())
    policy, remember, update = make_learner(env, frames)
    observation = env.reset()
    for seen in range(ENVS, frames + 1, ENVS):
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            stepped, observation = env.step_and_maybe_reset(policy(observation))
        remember(stepped)
        if seen >= BATCH + 2 * ENVS:
            update()
    games = Follow(512)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return games.rollout(CELLS - 1, policy)["next", "reward"].sum(1).mean().item()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=12_000)
    arguments = parser.parse_args()
    keep_freed_memory()
    learners: dict[str, Callable[..., Learner]] = {
        "TorchRL's stock recipe, fp32": stock_learner,
        "flowrep, fp32": flowrep_learner,
    }
    if has_fast_bf16(torch.device("cpu")):
        learners |= {
            "flowrep, bf16": partial(flowrep_learner, precision="bf16"),
            "flowrep, shared encoder, bf16": partial(
                flowrep_learner, precision="bf16", encoder="shared"
            ),
        }
    print(f"greedy return after {arguments.frames} frames; the best is {BEST:.2f}")
    for name, make_learner in learners.items():
        start = time.perf_counter()
        returns = [train(make_learner, arguments.frames, seed) for seed in range(arguments.seeds)]
        seconds = (time.perf_counter() - start) / arguments.seeds
        shown = "  ".join(f"{value:+.2f}" for value in returns)
        print(f"{name:30} mean {statistics.mean(returns):+.3f}   {shown}   {seconds:.0f} s a seed")


if __name__ == "__main__":
    main()
