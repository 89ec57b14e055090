"""Ego and object flow in MuJoCo.

A camera moves through a yard in which a ball rolls, a door swings and a crate slides. MuJoCo
renders depth and segmentation off-screen, and reports the poses of the camera and the bodies.
flowrep's transforms compute flow from these.

    pip install '.[examples]'
    apt-get install libegl1 libgl1-mesa-dri     # off-screen, on a CPU; or libosmesa6
    MUJOCO_GL=egl python examples/mujoco_flow.py strip.png

`sensors_from("mujoco")` converts MuJoCo's conventions, which tests/examples/test_mujoco_flow.py
measures:

- depth is already metres along the optical axis; pixels without a surface hold the far plane;
- pixels are sampled at their centres, so K has cx = W / 2, cy = H / 2 (with `offsamples="0"`);
- camera axes are OpenGL's (x right, y up, z backward), poses are camera-to-world;
- a body's pose is a position and a quaternion (w, x, y, z);
- segmentation is (geom id, object type) per pixel, -1 for the sky.
"""

import math
import os
import sys
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # read when mujoco is imported

import gymnasium as gym
import mujoco
import numpy as np
import torch
from gymnasium import spaces
from torchrl.envs import Compose, GymWrapper, TransformedEnv

from flowrep.geometry import intrinsics_from_fov
from flowrep.transforms import FlowFactorize, RawFlow, sensors_from

HEIGHT, WIDTH, FOV_DEG = 96, 144, 60.0
K = intrinsics_from_fov(FOV_DEG, axis="vertical", height=HEIGHT, width=WIDTH)
STEP_S, SUBSTEPS = 1 / 12, 20
FORWARD_MPS, YAW_RATE_RAD_S = 1.5, 0.3
SCENE = f"""
<mujoco>
  <option timestep="{STEP_S / SUBSTEPS}"/>
  <visual>
    <headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/>
    <quality offsamples="0"/>
    <map znear="0.01" zfar="20"/>
  </visual>
  <statistic extent="5" center="0 0 1"/>
  <asset>
    <texture name="tiles" type="2d" builtin="checker" rgb1=".3 .4 .3" rgb2=".6 .6 .5" width="128" height="128"/>
    <texture name="paint" type="cube" builtin="checker" rgb1=".9 .3 .2" rgb2=".9 .8 .3" width="64" height="64"/>
    <material name="tiles" texture="tiles" texrepeat="1 1" texuniform="true"/>
    <material name="paint" texture="paint"/>
  </asset>
  <worldbody>
    <geom type="plane" size="30 30 .1" material="tiles"/>
    <geom type="cylinder" size=".3 1" pos="-1.6 6 1" rgba=".5 .5 .6 1"/>
    <body name="rig" mocap="true" pos="0 0 1.2">
      <camera name="eye" fovy="{FOV_DEG}" xyaxes="1 0 0 0 .2 1"/>
    </body>
    <body name="ball" pos="1.8 4 .5">
      <freejoint/>
      <geom type="sphere" size=".4" material="paint"/>
    </body>
    <body name="door" pos="-1 4.5 .9">
      <joint name="hinge" type="hinge" axis="0 0 1"/>
      <geom type="box" size=".5 .04 .9" pos=".5 0 0" material="paint" contype="0" conaffinity="0"/>
    </body>
    <body name="crate" pos="1.5 7 .5">
      <joint name="rail" type="slide" axis="1 0 0"/>
      <geom type="box" size=".5 .5 .5" material="paint" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""  # noqa: E501
START_VELOCITIES = {"ball": (-1.0, 0.4, 0.0), "hinge": -1.0, "rail": -1.2}
BODIES = ("ball", "door", "crate")  # the moving bodies; all others are the static world


class Yard(gym.Env):
    """A camera that drives ahead; actions 0, 1, 2 go straight, turn left, turn right."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(SCENE)
        self.data = mujoco.MjData(self.model)
        self.renderer = mujoco.Renderer(self.model, HEIGHT, WIDTH)
        self.far_m = float(self.model.vis.map.zfar * self.model.stat.extent)
        self.body_ids = [self.model.body(name).id for name in BODIES]
        self.geom_ids = [int(self.model.body_geomadr[body]) for body in self.body_ids]  # one each
        anywhere = {"low": -np.inf, "high": np.inf, "dtype": np.float64}
        self.action_space = spaces.Discrete(3)
        self.observation_space = spaces.Dict(
            sensor=spaces.Dict(rgb=spaces.Box(0, 255, (3, HEIGHT, WIDTH), np.uint8)),
            depth=spaces.Box(0.0, np.inf, (HEIGHT, WIDTH), np.float32),
            segmentation=spaces.Box(-1, 1 << 15, (HEIGHT, WIDTH, 2), np.int32),
            camera_pose=spaces.Box(shape=(4, 4), **anywhere),
            xpos=spaces.Box(shape=(len(BODIES), 3), **anywhere),
            xquat=spaces.Box(shape=(len(BODIES), 4), **anywhere),
        )

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        ball = self.model.body("ball").dofadr[0]
        self.data.qvel[ball : ball + 3] = START_VELOCITIES["ball"]
        for joint in ("hinge", "rail"):
            self.data.joint(joint).qvel[0] = START_VELOCITIES[joint]
        self.yaw_rad = 0.0
        mujoco.mj_forward(self.model, self.data)
        return self.observe(), {}

    def step(self, action: Any) -> tuple[dict, float, bool, bool, dict]:
        self.yaw_rad += (0, 1, -1)[int(action)] * YAW_RATE_RAD_S * STEP_S
        sine, cosine = math.sin(self.yaw_rad), math.cos(self.yaw_rad)
        self.data.mocap_pos[0] += FORWARD_MPS * STEP_S * np.array([-sine, cosine, 0.0])
        half = self.yaw_rad / 2
        self.data.mocap_quat[0] = math.cos(half), 0.0, 0.0, math.sin(half)
        for _ in range(SUBSTEPS):
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)  # so that poses belong to the final positions
        return self.observe(), 0.0, False, self.data.time > 2.0, {}

    def observe(self) -> dict[str, Any]:
        """Returns MuJoCo's maps and poses in its own conventions."""
        rgb, depth, segmentation = self.pictures()
        eye, moving = self.data.camera("eye"), self.body_ids
        camera_pose = np.eye(4)
        camera_pose[:3, :3], camera_pose[:3, 3] = eye.xmat.reshape(3, 3), eye.xpos
        return {
            "sensor": {"rgb": np.ascontiguousarray(rgb.transpose(2, 0, 1))},
            "depth": depth,
            "segmentation": segmentation,
            "camera_pose": camera_pose,
            "xpos": self.data.xpos[moving],
            "xquat": self.data.xquat[moving],
        }

    def pictures(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns RGB, depth in metres, and (geom id, object type) of each pixel."""
        renderer = self.renderer
        renderer.update_scene(self.data, "eye")
        rgb = renderer.render().copy()
        renderer.enable_segmentation_rendering()
        segmentation = renderer.render().astype(np.int32)
        renderer.disable_segmentation_rendering()
        renderer.enable_depth_rendering()
        depth = renderer.render().copy()
        renderer.disable_depth_rendering()
        return rgb, depth, segmentation

    def close(self) -> None:
        self.renderer.close()


def make_env() -> TransformedEnv:
    """Returns the yard as a TorchRL env that adds raw, ego and obj to MuJoCo's data."""
    yard = Yard()
    standing = [geom for geom in range(yard.model.ngeom) if geom not in yard.geom_ids]
    transforms = Compose(
        *sensors_from("mujoco", body_ids=yard.geom_ids, static_ids=standing, far_m=yard.far_m),
        RawFlow(K),
        FlowFactorize(K),
    )
    return TransformedEnv(GymWrapper(yard, categorical_action_encoding=True), transforms)


def main(path: str | None = None) -> None:
    env = make_env()
    frames = env.rollout(12, policy=lambda td: td.set("action", torch.tensor(1)))["next"]
    raw, ego, obj = (frames[name] for name in ("raw", "ego", "obj"))
    moving = frames["sensor", "instance"] > 0
    speed = obj.norm(dim=-3, keepdim=True)
    print(f"{len(frames)} frames of {WIDTH} x {HEIGHT}, raw flow up to {raw.abs().max():.1f} px")
    print(f"max |raw - ego - obj|      {(raw - ego - obj).abs().max():.1e} px")
    print(f"max |obj| of what stands   {speed[~moving].max():.1e} px")
    for row, name in enumerate(BODIES, start=1):
        body = frames["sensor", "instance"] == row
        print(f"median |obj| of the {name:6} {speed[body].median():.2f} px")
    if path is not None:
        from flowrep.viz import representation_strip, write_png

        frame = frames[len(frames) // 2]
        maps = dict(frame["sensor"].items()) | {name: frame[name] for name in ("raw", "ego", "obj")}
        write_png(path, representation_strip(maps, depth_range_m=20.0))
        print(f"{path}: the {len(frames) // 2}th of them")
    env.close()


if __name__ == "__main__":
    main(*sys.argv[1:2])
