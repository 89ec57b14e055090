"""Ego and object flow in MiniWorld, where maps and poses take three lines of code each.

    pip install '.[examples]'
    apt-get install libegl1 libgl1-mesa-dri
    python examples/miniworld_flow.py strip.png

A box slides through a room. MiniWorld's conventions, as measured by warping frames in
tests/examples/test_other_simulators.py:

- depth is metres along the optical axis, from a 16-bit z-buffer: steps of 4 cm at 10 m;
- y is up and an agent's `dir` is an angle about it; camera axes are OpenGL's;
- pictures are multisampled, which shifts depth by 0.38 px; a frame buffer with one sample doesn't;
- there are no ids, so the room is also drawn without the body, and the body is where depth differs.
"""

import os
import sys
from itertools import cycle
from typing import Any

os.environ.setdefault("PYGLET_HEADLESS", "1")  # read when pyglet is imported

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from miniworld.envs import OneRoom
from miniworld.opengl import FrameBuffer
from tensordict import TensorDictBase
from torchrl.envs import Compose, GymWrapper, TransformedEnv

from flowrep.geometry import intrinsics_from_fov
from flowrep.transforms import AdaptPose, CameraMotion, FlowFactorize, InstanceMotion, RawFlow

HEIGHT, WIDTH, FOV_DEG = 96, 128, 60.0
K = intrinsics_from_fov(FOV_DEG, axis="vertical", height=HEIGHT, width=WIDTH)
SLIDE_M = 0.1  # a step
LEFT, RIGHT, FORWARD = 0, 1, 2
CAMERA = ("sensor", "world_from_camera")


class Room(gym.Wrapper):
    """MiniWorld's room with a box that slides from wall to wall, as maps and poses."""

    def __init__(self) -> None:
        super().__init__(OneRoom(size=8, domain_rand=False))
        self.plain = FrameBuffer(WIDTH, HEIGHT, 1)
        pose = spaces.Box(-np.inf, np.inf, (4, 4), np.float64)
        one = (1, HEIGHT, WIDTH)
        self.observation_space = spaces.Dict(
            sensor=spaces.Dict(
                rgb=spaces.Box(0, 255, (3, HEIGHT, WIDTH), np.uint8),
                depth=spaces.Box(0.0, np.inf, one, np.float32),
                instance=spaces.Box(0, 1, one, np.uint8),
                world_from_body=spaces.Box(-np.inf, np.inf, (1, 4, 4), np.float64),
                world_from_camera=pose,
            )
        )

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.env.reset(seed=seed)
        self.env.box.pos, self.slide_m = np.array([7.0, 0.0, 4.0]), SLIDE_M
        self.env.agent.pos, self.env.agent.dir = np.array([1.5, 0.0, 4.0]), 0.0
        return self.observe(), {}

    def step(self, action: Any) -> tuple[dict, float, bool, bool, dict]:
        _, reward, ended, cut, info = self.env.step(action)
        self.env.box.pos = np.add(self.env.box.pos, (0.0, 0.0, self.slide_m))
        if not 1.0 < self.env.box.pos[2] < 7.0:
            self.slide_m = -self.slide_m
        return self.observe(), reward, ended, cut, info

    def observe(self) -> dict[str, Any]:
        """Returns this step's maps and poses, channels first."""
        room = self.env
        rgb, depth = room.render_obs(self.plain), room.render_depth(self.plain)
        room.entities.remove(room.box)
        behind = room.render_depth(self.plain)
        room.entities.append(room.box)
        ahead, up = room.agent.cam_dir, np.array([0.0, 1.0, 0.0])
        camera, body = np.eye(4), np.eye(4)
        camera[:3] = np.stack([np.cross(ahead, up), up, -ahead, room.agent.cam_pos], axis=1)
        body[:3, 3] = room.box.pos  # it slides without turning
        sensor = {
            "rgb": rgb.transpose(2, 0, 1).copy(),
            "depth": depth.transpose(2, 0, 1).copy(),
            "instance": (depth != behind).astype(np.uint8).transpose(2, 0, 1).copy(),
            "world_from_body": body[None],
            "world_from_camera": camera,
        }
        return {"sensor": sensor}


def make_env() -> TransformedEnv:
    """Returns the room as a TorchRL env that writes raw, ego and obj."""
    transforms = Compose(
        AdaptPose(axes="opengl", in_keys=[CAMERA]),
        CameraMotion(),
        InstanceMotion(),
        RawFlow(K),
        FlowFactorize(K),
    )
    return TransformedEnv(GymWrapper(Room(), categorical_action_encoding=True), transforms)


def drive(env: TransformedEnv, steps: int = 18) -> TensorDictBase:
    """Returns the frames of a drive ahead with small turns to both sides."""
    actions = cycle([FORWARD, LEFT, FORWARD, RIGHT])
    env.set_seed(1)
    return env.rollout(steps, lambda td: td.set("action", torch.tensor(next(actions))))["next"]


def main(path: str | None = None) -> None:
    from flowrep import diagnose

    env = make_env()
    frames = drive(env)
    print(diagnose(frames, K))
    if path is not None:
        from flowrep.viz import representation_strip, write_png

        frame = frames[8]
        maps = dict(frame["sensor"].items()) | {name: frame[name] for name in ("raw", "ego", "obj")}
        write_png(path, representation_strip(maps, depth_range_m=10.0))
    env.close()


if __name__ == "__main__":
    main(*sys.argv[1:2])
