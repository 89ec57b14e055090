"""Ego and object flow for ManiSkill 3's robots.

pip install '.[examples]' mani_skill
apt-get install mesa-vulkan-drivers        # on a CPU, in version 25 or newer
python examples/maniskill_flow.py strip.png
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium as gym
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, TransformedEnv

from flowrep import diagnose, transforms


class ManiSkillEnv(EnvBase):
    """A batch of ManiSkill envs, which emits one camera's maps and the poses of all bodies.

    Unlike TorchRL's `GymWrapper`, it keeps the batch dimension if there is only one env.

    | writes under `"sensor"` | shape | from |
    | --- | --- | --- |
    | `rgb` | uint8 `[N, 3, H, W]` | |
    | `millimetres` | int16 `[N, H, W, 1]`, 0 is nothing | `depth` |
    | `instance` | int16 `[N, 1, H, W]`, 0 is the background | `segmentation` |
    | `world_from_body` | float32 `[N, M, 4, 4]`, row i - 1 of id i | `segmentation_id_map` |
    | `opengl_pose` | float32 `[N, 4, 4]`, camera to world | `cam2world_gl` |
    | `K` | float32 `[N, 3, 3]`, pixel centres at halves | `intrinsic_cv` |

    `flow_transforms()` compute raw, ego and obj from these. A part of the robot that moves with the
    camera stands still in the picture, so its object flow is minus the ego flow.

    Args:
        env: made with `obs_mode="rgb+depth+segmentation"`.
        camera: a sensor's name, e.g. `"base_camera"`.
    """

    def __init__(self, env: Any, camera: str) -> None:
        self.env, self.camera = env, camera
        batch = torch.Size([env.unwrapped.num_envs])
        super().__init__(device=env.unwrapped.device, batch_size=batch)
        observation, _ = env.reset(seed=0)
        sensor = self._sensor(observation)
        spec: dict[str, Any] = {
            name: Unbounded(x.shape, dtype=x.dtype, device=self.device)
            for name, x in sensor.items()
        }
        spec["rgb"] = Bounded(0, 255, sensor["rgb"].shape, dtype=torch.uint8, device=self.device)
        # The static world and M bodies: RawFlow compares this with the number of motions.
        ids, rows = sensor["instance"], 1 + sensor["world_from_body"].shape[-3]
        spec["instance"] = Categorical(rows, ids.shape, dtype=ids.dtype, device=self.device)
        self.observation_spec = Composite(sensor=Composite(spec, shape=batch), shape=batch)
        space = env.unwrapped.single_action_space
        low, high = (
            torch.as_tensor(bound, device=self.device).expand(*batch, -1)
            for bound in (space.low, space.high)
        )
        self.action_spec = Bounded(low, high, low.shape, dtype=low.dtype, device=self.device)
        self.reward_spec = Unbounded((*batch, 1), device=self.device)
        flag = Binary(1, (*batch, 1), dtype=torch.bool, device=self.device)
        ends = {name: flag.clone() for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(ends, shape=batch)

    def _sensor(self, observation: dict[str, Any]) -> dict[str, Tensor]:
        maps = observation["sensor_data"][self.camera]
        camera = observation["sensor_param"][self.camera]
        bodies = self.env.unwrapped.segmentation_id_map
        poses = torch.eye(4, device=self.device).repeat(*self.batch_size, max(bodies), 1, 1)
        for number, body in bodies.items():
            poses[:, number - 1] = body.pose.to_transformation_matrix()
        return {
            "rgb": maps["rgb"].movedim(-1, -3),
            "millimetres": maps["depth"].clone(),
            "instance": maps["segmentation"].movedim(-1, -3).clone(),
            "world_from_body": poses,
            "opengl_pose": camera["cam2world_gl"].clone(),
            "K": camera["intrinsic_cv"].clone(),
        }

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        options = {}
        if tensordict is not None and "_reset" in tensordict:
            options["env_idx"] = tensordict["_reset"].flatten().nonzero().flatten()
        observation, _ = self.env.reset(options=options)
        return self._tensordict(sensor=self._sensor(observation))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, reward, terminated, truncated, _ = self.env.step(tensordict["action"])
        return self._tensordict(
            sensor=self._sensor(observation),
            reward=reward.float().unsqueeze(-1),
            terminated=terminated.unsqueeze(-1),
            truncated=truncated.unsqueeze(-1),
            done=(terminated | truncated).unsqueeze(-1),
        )

    def _tensordict(self, **values: Any) -> TensorDictBase:
        return TensorDict(values, self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        self.env.reset(seed=seed)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes the env."""
        super().close(raise_if_closed=raise_if_closed)
        self.env.close()


def flow_transforms() -> Compose:
    """Returns the transforms that write raw, ego and obj of a `ManiSkillEnv`."""
    named = {"depth": ("sensor", "millimetres"), "cam2world_gl": ("sensor", "opengl_pose")}
    K = ("sensor", "K")
    camera = {"intrinsics": K, "prev_intrinsics": K}  # it never zooms
    return Compose(
        *transforms.sensors_from("maniskill", keys=named),
        transforms.InstanceMotion(),
        transforms.RawFlow(**camera),
        transforms.FlowFactorize(**camera),
    )


def make_env(task: str = "PickCube-v1", camera: str = "hand_camera") -> TransformedEnv:
    """Returns a task as a TorchRL env that writes raw, ego and obj of its camera."""
    import mani_skill.envs  # noqa: F401 - registers the envs

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
