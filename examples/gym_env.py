"""Ego and object flow in your own gymnasium env, through TorchRL's GymEnv.

The env below has a wall, a square that rises in front of it, and a moving camera. It returns depth,
ids and poses, which are all that flowrep's transforms need to compute flow.

    python examples/gym_env.py
"""

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torchrl.envs import Compose, GymEnv, TransformedEnv

from flowrep.transforms import CameraMotion, FlowFactorize, InstanceMotion, RawFlow

HEIGHT, WIDTH, FOCAL_PX = 40, 60, 50.0
K = [[FOCAL_PX, 0.0, WIDTH / 2], [0.0, FOCAL_PX, HEIGHT / 2], [0.0, 0.0, 1.0]]
WALL_M, SQUARE_M, HALF_SIDE_M = 6.0, 3.0, 0.5
DRIFT_M, RISE_M = 0.06, 0.12  # a step


class Drift(gym.Env):
    """A camera facing along z, with x right and y down, that moves right (1) or left (0)."""

    def __init__(self) -> None:
        pose = spaces.Box(-np.inf, np.inf, (4, 4), np.float64)
        sensor = {
            "depth": spaces.Box(0.0, np.inf, (1, HEIGHT, WIDTH), np.float32),
            "instance": spaces.Box(0, 1, (1, HEIGHT, WIDTH), np.uint8),
            "world_from_cam": pose,
            "world_from_body": spaces.Box(-np.inf, np.inf, (1, 4, 4), np.float64),
        }
        self.observation_space = spaces.Dict(sensor=spaces.Dict(sensor))
        self.action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        self.steps, self.camera, self.square = 0, np.eye(4), np.eye(4)
        self.square[:3, 3] = 0.0, 0.5, SQUARE_M
        return self.observe(), {}

    def step(self, action: Any) -> tuple[dict, float, bool, bool, dict]:
        self.steps += 1
        self.camera[0, 3] += DRIFT_M if action else -DRIFT_M
        self.square[1, 3] -= RISE_M
        return self.observe(), 0.0, False, self.steps == 8, {}

    def observe(self) -> dict[str, dict[str, np.ndarray]]:
        # The points where the rays through the pixels' centres meet the plane of the square.
        x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL_PX * SQUARE_M + self.camera[0, 3]
        y = (np.arange(HEIGHT)[:, None] + 0.5 - HEIGHT / 2) / FOCAL_PX * SQUARE_M
        offset = np.maximum(abs(x - self.square[0, 3]), abs(y - self.square[1, 3]))
        hit = offset < HALF_SIDE_M
        sensor = {
            "depth": np.where(hit, SQUARE_M, WALL_M).astype(np.float32)[None],
            "instance": hit.astype(np.uint8)[None],  # 0 is the static world, 1 the first body
            "world_from_cam": self.camera.copy(),
            "world_from_body": self.square[None].copy(),
        }
        return {"sensor": sensor}


gym.register("Drift-v0", Drift)


def make_env() -> TransformedEnv:
    transforms = Compose(CameraMotion(), InstanceMotion(), RawFlow(K), FlowFactorize(K))
    return TransformedEnv(GymEnv("Drift-v0", categorical_action_encoding=True), transforms)


def main() -> None:
    env = make_env()
    frames = env.rollout(4, policy=lambda td: td.set("action", torch.tensor(1)))["next"]
    square = frames["sensor", "instance"][:, 0] == 1
    for name in ("raw", "ego", "obj"):
        flow = frames[name].movedim(1, -1)  # [T, H, W, 2]
        on_square, on_wall = (flow[mask][0].tolist() for mask in (square, ~square))
        shown = [f"({u:+.2f}, {v:+.2f})" for u, v in (on_square, on_wall)]
        print(f"{name}: square {shown[0]} px, wall {shown[1]} px")


if __name__ == "__main__":
    main()
