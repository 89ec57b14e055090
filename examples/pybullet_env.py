"""Ego and object flow in an existing PyBullet env: panda-gym, seen by a camera that orbits.

    pip install '.[sim,examples]'
    python examples/pybullet_env.py strip.png

`BulletFlow` adds a camera to any gymnasium env on PyBullet. It needs the env's PyBullet client and,
for a camera that is mounted on the robot, the robot's body number.
"""

import itertools
import sys
from typing import Any

import gymnasium as gym
import panda_gym  # noqa: F401 - registers the envs
import torch
from torchrl.envs import Compose, GymWrapper, TransformedEnv

from flowrep import diagnose
from flowrep.pybullet import BulletCamera, BulletFlow
from flowrep.transforms import FlowFactorize, RawFlow

HEIGHT, WIDTH, DEG_PER_STEP = 120, 180, 1.5


def orbiting(env: Any) -> BulletCamera:
    """Returns a camera that moves around the table during the episode."""
    client, yaws_deg = env.sim.physics_client, itertools.count(40, DEG_PER_STEP)

    def view() -> list[float]:
        return client.computeViewMatrixFromYawPitchRoll([0, 0, 0.2], 0.9, next(yaws_deg), -25, 0, 2)

    return BulletCamera(client, WIDTH, HEIGHT, fov_deg=50, view=view, rgb=True)


def on_hand(env: Any) -> BulletCamera:
    """Returns a camera at the gripper, which looks along its fingers."""
    link = env.sim._bodies_idx["panda"], env.robot.ee_link
    return BulletCamera(env.sim.physics_client, WIDTH, HEIGHT, fov_deg=80, link=link, rgb=True)


def make_env(task: str = "PandaPush-v3", camera: Any = orbiting) -> TransformedEnv:
    """Returns a task as a TorchRL env that writes raw, ego and obj of a camera's maps."""
    env = BulletFlow(gym.make(task), camera)
    return TransformedEnv(GymWrapper(env), Compose(RawFlow(env.K), FlowFactorize(env.K)))


def main(path: str | None = None) -> None:
    env = make_env()
    env.set_seed(3)
    torch.manual_seed(3)
    frames = env.rollout(20)["next"]
    print(diagnose(frames, env.get_wrapper_attr("K")))
    speed, rows = frames["obj"].norm(dim=-3, keepdim=True), env.get_wrapper_attr("camera").rows
    for name, body in env.unwrapped.sim._bodies_idx.items():
        links = torch.tensor([row for (number, _), row in rows.items() if number == body])
        pixels = torch.isin(frames["sensor", "instance"], links)
        print(f"obj of the {name:6} up to {speed[pixels].max():.2f} px")
    if path is not None:
        from flowrep.viz import representation_strip, write_png

        frame = frames[len(frames) // 2]
        maps = dict(frame["sensor"].items()) | {name: frame[name] for name in ("raw", "ego", "obj")}
        write_png(path, representation_strip(maps, depth_range_m=2.0))
    env.close()


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*sys.argv[1:2])
