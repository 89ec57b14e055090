"""How well can Straight Road be driven with some maps, if exploring is not the problem?

A teacher, a Q-function on the simulator's state, is trained without pictures and kept in a file. A
student on maps then drives by its own actions and learns the teacher's values of the frames it
sees, never from rewards.

pip install '.[train]'
python examples/distillation.py --maps raw --frames 100000
"""

import argparse
import json
import math
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from tqdm import trange

from flowrep.agent import DiscreteSAC, keep_freed_memory
from flowrep.agent.map_codec import store_maps
from flowrep.config.algorithms import DiscreteSACOptions
from flowrep.envs import StreetEnv, make_env, make_mirror
from flowrep.envs.street_env import Episode, reward
from flowrep.envs.torchrl_env import street_envs
from flowrep.experiment.evaluation import evaluate
from flowrep.scenes import Scene, load_scene

NUM_ENVS, LEAST_ALPHA = 32, 0.02  # alpha weighs the entropy against the values
PEOPLE, IN_SIGHT_M = 8, 30.0  # the nearest people are part of the state
SWAPPED = torch.tensor([0, 2, 1])  # actions in the mirror image of a straight street
# The sign of each part of a state in the mirror image.
SIGNS = torch.tensor([1.0, -1, -1, 1, -1] + [1.0, -1, 1, -1, 1] * PEOPLE)


def state_of(episode: Episode) -> np.ndarray:
    """Returns the vehicle's pose and yaw rate, and position and velocity of the nearest people."""
    x, y, yaw, yaw_rate = episode.now.vehicle
    time_s = episode.now.ticks * episode.tick_s
    position = episode.crowd.positions(time_s)
    velocity = (episode.crowd.positions(time_s + 0.05) - position) / 0.05
    axes = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    position, velocity = (position - [x, y]) @ axes, velocity @ axes
    distance = np.hypot(*position.T)
    nearest = np.argsort(distance)
    nearest = nearest[(distance < IN_SIGHT_M)[nearest] & (position[nearest, 0] > -4)][:PEOPLE]
    people = np.zeros((PEOPLE, 5))
    people[: len(nearest)] = np.column_stack(
        [position[nearest] / 10, velocity[nearest] / 2, np.ones(len(nearest))]
    )
    vehicle = [x / 50, y / 4, 3 * math.sin(yaw), math.cos(yaw), yaw_rate]
    return np.concatenate([vehicle, people.ravel()]).astype(np.float32)


class StateQ(nn.Module):
    """Maps states `[N, 45]` to values `[N, 3]`; the order of people doesn't matter."""

    def __init__(self) -> None:
        super().__init__()
        self.person = nn.Sequential(nn.Linear(10, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU())
        self.head = nn.Sequential(
            nn.Linear(133, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 3)
        )

    def forward(self, state: Tensor) -> Tensor:
        vehicle, people = state[:, :5], state[:, 5:].unflatten(1, (PEOPLE, 5))
        both = torch.cat([people, vehicle[:, None].expand_as(people)], -1)
        features = self.person(both) * people[..., 4:]
        return self.head(torch.cat([vehicle, features.amax(1), features.mean(1)], -1))


def values(teacher: nn.ModuleList, state: Tensor) -> Tensor:
    """Returns the smaller of two Qs `[N, 3]`, each averaged over the state and its mirror image."""
    both = [(q(state) + q(state * SIGNS)[:, SWAPPED]) / 2 for q in teacher]
    return torch.minimum(*both)


def train_teacher(scene: Scene, frames: int, seed: int) -> nn.ModuleList:
    """Returns two Q-functions, trained by soft Q-learning on returns of five steps."""
    torch.manual_seed(seed)
    gamma, steps, lag = 0.97, 5, 5 * NUM_ENVS
    envs = [StreetEnv(scene, speed=(0.4, 2.6), sensors=()) for _ in range(NUM_ENVS)]
    for i, env in enumerate(envs):
        env.begin(seed=seed * 1000 + i)
    teacher, target = (nn.ModuleList(StateQ() for _ in range(2)) for _ in range(2))
    target.load_state_dict(teacher.state_dict())
    optimizer = torch.optim.Adam(teacher.parameters(), 5e-4)
    # the steps of all envs, in the order of time
    states, actions = torch.zeros(frames, len(SIGNS)), torch.zeros(frames, dtype=torch.long)
    rewards, ended = torch.zeros(frames), torch.zeros(frames, dtype=torch.bool)
    for first in trange(0, frames - NUM_ENVS + 1, NUM_ENVS, desc="teacher"):
        alpha = max(LEAST_ALPHA, 0.3 * math.exp(-first / 60_000))
        optimizer.param_groups[0]["lr"] = 5e-4 * (1 - first / frames)
        now = slice(first, first + NUM_ENVS)
        states[now] = torch.from_numpy(np.stack([state_of(env.episode) for env in envs]))
        with torch.no_grad():
            actions[now] = Categorical(logits=values(teacher, states[now]) / alpha).sample()
        for row, env in enumerate(envs, first):
            outcome = env.drive(int(actions[row]))
            rewards[row], ended[row] = reward(outcome), bool(outcome)
            if outcome:
                env.begin()
        for _ in range(4 if first >= 4000 else 0):
            i = torch.randint(first - lag, (256,))
            returns, alive = torch.zeros(256), torch.ones(256)
            for k in range(steps):
                returns += alive * gamma**k * rewards[i + k * NUM_ENVS]
                alive *= ~ended[i + k * NUM_ENVS]
            is_image = torch.rand(256, 1) < 0.5
            state, later = (
                torch.where(is_image, x * SIGNS, x) for x in (states[i], states[i + lag])
            )
            action = torch.where(is_image, SWAPPED[actions[i, None]], actions[i, None])
            with torch.no_grad():
                q = torch.minimum(*(each(later) for each in target))
                value = ((q / alpha).softmax(-1) * q).sum(-1)
                goal = returns + alive * gamma**steps * value
            chosen = [q(state).gather(1, action).squeeze(1) for q in teacher]
            loss = sum((each - goal).square().mean() for each in chosen)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            with torch.no_grad():
                torch._foreach_lerp_([*target.parameters()], [*teacher.parameters()], 0.01)
    return teacher


def distil(
    teacher: nn.ModuleList,
    scene: Scene,
    maps: list[str],
    speed: list[float],
    frames: int,
    seed: int,
) -> ProbabilisticTensorDictSequential:
    """Returns the student, trained by one update for each step of the envs."""
    torch.manual_seed(seed)
    env = make_env(scene, maps, num_envs=NUM_ENVS, speed=(speed[0], speed[1]), seed=seed * NUM_ENVS)
    streets = street_envs(env)
    options = DiscreteSACOptions(precision="fp32", hidden_size=512, layer_norm=True)
    specs = env.observation_spec, env.action_spec
    student = DiscreteSAC.make_policy(*specs, maps, options, total_frames=frames)
    network = student[0].module
    optimizer = torch.optim.Adam(student.parameters(), 3e-4, fused=True)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, frames // NUM_ENVS)
    memory = TensorDictReplayBuffer(storage=LazyTensorStorage(50_000), batch_size=128)
    memory.append_transform(make_mirror(scene, maps))
    seen = env.reset()
    with closing(env), trange(frames // NUM_ENVS, desc="student") as bar:
        for _ in bar:
            state = torch.from_numpy(np.stack([state_of(street.episode) for street in streets]))
            with torch.no_grad():
                label = values(teacher, state)
                seen = student(seen)
            # As an action, so that mirror images exchange the values of left and right.
            memory.extend(store_maps(network.codecs, seen).set("action", label))
            seen = env.step_and_maybe_reset(seen)[1]
            batch = memory.sample()
            log_policy = network(*(batch[name] for name in maps)).log_softmax(-1)
            policy, q = log_policy.exp(), batch["action"]
            regret = q.amax(-1) - (policy * q).sum(-1)
            loss = (regret + LEAST_ALPHA * (policy * log_policy).sum(-1)).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            bar.set_postfix(regret=f"{regret.mean():.3f}", refresh=False)
    return student


def success(
    student: ProbabilisticTensorDictSequential, scene: Scene, maps: list[str], episodes: int
) -> dict[str, float]:
    """Returns the student's share of successes at each of the scene's speeds."""
    shares = {}
    for speed in ("low", "normal", "high"):
        # the seeds of the results page
        seeds = [{"episode_seed": 1_500_000 + i} for i in range(episodes)]
        with closing(make_env(scene, maps, num_envs=min(episodes, 96), speed=speed)) as env:
            ends = [record.outcome for record in evaluate(env, student, seeds)]
        shares[speed] = round(ends.count("success") / episodes, 4)
    return shares


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--maps", nargs="+", default=["ego", "obj"])
    parser.add_argument("--size", type=int, default=60, help="of the maps, pixels")
    parser.add_argument("--speed", nargs=2, type=float, default=[0.6, 2.4], help="m/s")
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=192)
    parser.add_argument("--teacher", type=Path, default=Path("teacher.pt"))
    parser.add_argument("--teacher-frames", type=int, default=240_000)
    args = parser.parse_args()
    keep_freed_memory()
    torch.set_num_threads(1)
    scene = load_scene("straight_road")  # its mirror image is itself, which `values` relies on
    camera = replace(scene.camera, height_px=args.size, width_px=args.size)
    scene = replace(scene, camera=camera)
    if args.teacher.exists():
        teacher = nn.ModuleList(StateQ() for _ in range(2))
        teacher.load_state_dict(torch.load(args.teacher, weights_only=True))
    else:
        teacher = train_teacher(scene, args.teacher_frames, args.seed)
        torch.save(teacher.state_dict(), args.teacher)
    student = distil(teacher, scene, args.maps, args.speed, args.frames, args.seed)
    shares = success(student, scene, args.maps, args.episodes)
    print(json.dumps({name: str(value) for name, value in vars(args).items()} | shares))
