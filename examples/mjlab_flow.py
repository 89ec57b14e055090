"""Ego and object flow of wrist cameras in mjlab, for a batch of envs at once.

    pip install '.[examples]' 'mjlab>=1.6,<1.7'  # pins MuJoCo and MuJoCo Warp 3.11
    python examples/mjlab_flow.py strip.png

It runs on a CPU, which mjlab supports "for development". At the first start, Warp compiles its
kernels for some minutes.

An mjlab observation group contains what flow needs. TorchRL's `MJLabWrapper` passes it on, and
`sensors_from("mjlab")` converts its conventions. Note that:

- all spaces are float32, so ids arrive as floats, and are converted here;
- a geom moves with its body, so geoms that share a body have the same pose;
- if a camera has a sensor size in MuJoCo's model, as here, K follows from it and not from `fovy`.
  The renderer crops the sensor to the picture's aspect ratio.
"""

import sys
from functools import partial
from typing import Any

import mjlab.tasks  # noqa: F401 - registers the tasks
import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import ObservationGroupCfg, ObservationTermCfg
from mjlab.sensor import CameraSensorCfg
from mjlab.tasks.registry import load_env_cfg
from torch import Tensor
from torchrl.envs import Compose, DTypeCastTransform, MJLabWrapper, TransformedEnv

import flowrep
from flowrep.transforms import FlowFactorize, RawFlow, sensors_from

HEIGHT, WIDTH = 64, 112
TASK, WRIST = "Mjlab-Lift-Cube-Yam", "robot/camera_d405"


def intrinsics(env: Any) -> Tensor:
    """Returns K of the wrist camera from its focal lengths and sensor size, in metres in MuJoCo."""
    model, camera = env.sim.mj_model, env.scene["eye"].camera_idx
    width_m, height_m = model.cam_sensorsize[camera]
    px_per_m = max(WIDTH / width_m, HEIGHT / height_m)  # cropped to the picture's aspect ratio
    fx, fy, cx, cy = model.cam_intrinsic[camera] * px_per_m
    return torch.tensor([[fx, 0, WIDTH / 2 - cx], [0, fy, HEIGHT / 2 - cy], [0, 0, 1]]).float()


def moving_geoms(env: Any) -> list[int]:
    """Returns the geoms of all bodies that aren't welded to the world."""
    model = env.sim.mj_model
    return model.body_weldid[model.geom_bodyid].nonzero()[0].tolist()


def camera_map(env: Any, name: str) -> Tensor:
    return getattr(env.scene["eye"].data, name).float()


def camera_pose(env: Any) -> Tensor:
    camera, data = env.scene["eye"].camera_idx, env.sim.data
    pose = torch.eye(4, device=env.device).repeat(env.num_envs, 1, 1)
    pose[:, :3, :3], pose[:, :3, 3] = data.cam_xmat[:, camera], data.cam_xpos[:, camera]
    return pose


def geom_poses(env: Any, name: str) -> Tensor:
    """Returns the positions or quaternions of the moving geoms' bodies."""
    bodies = torch.as_tensor(env.sim.mj_model.geom_bodyid[moving_geoms(env)], device=env.device)
    return getattr(env.sim.data, name)[:, bodies.long()]


def make_env(num_envs: int = 2) -> TransformedEnv:
    """Returns the task as a TorchRL env that writes raw, ego and obj of its cameras' maps."""
    config = load_env_cfg(TASK)
    config.scene.num_envs = num_envs
    eye = CameraSensorCfg(
        name="eye",
        camera_name=WRIST,
        height=HEIGHT,
        width=WIDTH,
        data_types=("depth", "segmentation"),
        enabled_geom_groups=(0, 3),  # draw the robot's collision shapes, as mjlab's task does
    )
    config.scene.sensors = (*config.scene.sensors, eye)
    terms = {
        "depth": partial(camera_map, name="depth"),
        "segmentation": partial(camera_map, name="segmentation"),
        "camera_pose": camera_pose,
        "xpos": partial(geom_poses, name="xpos"),
        "xquat": partial(geom_poses, name="xquat"),
    }
    config.observations["eye"] = ObservationGroupCfg(
        {name: ObservationTermCfg(func=function) for name, function in terms.items()},
        concatenate_terms=False,
    )
    env = ManagerBasedRlEnv(config, device="cpu")
    K, geoms, ids = intrinsics(env), moving_geoms(env), ("eye", "segmentation")
    flow = Compose(
        DTypeCastTransform(torch.float32, torch.int32, in_keys=[ids], out_keys=[ids]),
        *sensors_from(
            "mjlab",
            body_ids=geoms,
            static_ids=sorted({*range(env.sim.mj_model.ngeom)} - {*geoms}),
            prefix="eye",
        ),
        RawFlow(K),
        FlowFactorize(K),
    )
    return TransformedEnv(MJLabWrapper(env), flow)


def main(path: str | None = None) -> None:
    env = make_env()
    torch.manual_seed(0)
    frames = env.rollout(20)["next"]
    print(flowrep.diagnose(frames, intrinsics(env)))
    if path is not None:
        from flowrep.viz import representation_strip, write_png

        frame = frames[0, 10]
        maps = dict(frame["sensor"].items()) | {name: frame[name] for name in ("raw", "ego", "obj")}
        write_png(path, representation_strip(maps, depth_range_m=1.0))
    env.close()


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*sys.argv[1:2])
