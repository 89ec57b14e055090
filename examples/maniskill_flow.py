"""Ego and object flow for ManiSkill 3's robots.

pip install '.[examples]' mani_skill
apt-get install mesa-vulkan-drivers        # on a CPU, in version 25 or newer
python examples/maniskill_flow.py strip.png
"""

import sys

import gymnasium as gym
import mani_skill.envs  # noqa: F401 - registers the envs
import torch
from torchrl.envs import TransformedEnv

from flowrep import diagnose
from flowrep.maniskill import ManiSkillEnv, flow_transforms


def make_env(task: str = "PickCube-v1", camera: str = "hand_camera") -> TransformedEnv:
    """Returns a task as a TorchRL env that writes raw, ego and obj as its camera sees them."""
    robot = {"robot_uids": "panda_wristcam"} if camera == "hand_camera" else {}
    env = gym.make(task, obs_mode="rgb+depth+segmentation", max_episode_steps=50, **robot)
    return TransformedEnv(ManiSkillEnv(env, camera), flow_transforms())


def main(path: str | None = None) -> None:
    env = make_env()
    env.set_seed(1)
    frames = env.rollout(25)["next"]
    print(diagnose(frames))
    if path is not None:
        from flowrep.viz import representation_strip, write_png

        frame = frames[0, 12]
        maps = dict(frame["sensor"].items()) | {name: frame[name] for name in ("raw", "ego", "obj")}
        write_png(path, representation_strip(maps, depth_range_m=3.0))
    env.close()


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*sys.argv[1:2])
