"""Stable-Baselines3's PPO, unmodified, on ego and object flow.

    pip install '.[train,learners]'
    python examples/stable_baselines3_ppo.py --steps 200000
    python -m flowrep.evaluate policy=examples/stable_baselines3_ppo.py:make \
        'representations=[ego,obj]' scene=straight_road

A few thousand steps suffice to see that it runs; learning to drive takes about 100,000.
"""

import argparse

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import flowrep.envs  # noqa: F401 - registers the streets with gymnasium


def train(steps: int, num_envs: int = 4, rollout_length: int = 128, seed: int = 0) -> PPO:
    """Returns the trained agent."""
    options = {"representations": ["ego", "obj"], "truncate_timeouts": True}
    envs = make_vec_env(
        lambda: gym.make("flowrep/StraightRoad-v0", **options), n_envs=num_envs, seed=seed
    )
    learner = PPO(
        "CnnPolicy",
        envs,
        n_steps=rollout_length,
        batch_size=rollout_length,
        # Flow is not a uint8 picture and must not be divided by 255.
        policy_kwargs={"normalize_images": False},
        seed=seed,
        device="auto",
        verbose=1,
    )
    learner.learn(total_timesteps=steps)
    envs.close()
    return learner


def make(task, path: str = "ppo_street"):
    """Returns the saved agent as a policy for `flowrep.evaluate`."""
    learner = PPO.load(path, device="auto")

    def act(maps):
        joined = np.concatenate([maps[name].cpu().numpy() for name in task.representations], 1)
        return learner.predict(joined, deterministic=True)[0]

    return act


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    train(args.steps, seed=args.seed).save("ppo_street")
