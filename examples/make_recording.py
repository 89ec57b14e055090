"""Writes a small recording to try `flowrep.factorize` on: ten frames of a street with people.

    python examples/make_recording.py street
    python -m flowrep.factorize input=street format=frames output=out

It contains pictures, depth, the camera's poses and the simulator's exact flow, so you can also try
`flow=exact`, `poses=estimated` and wrong options (`format.pose_axes=opengl`).
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from flowrep.baselines import Planner
from flowrep.envs import StreetEnv
from flowrep.envs.sensing import SENSORS
from flowrep.geometry import rigid_flow
from flowrep.scenes import load_scene
from flowrep.sequences import write_flo
from flowrep.viz import write_png


def make_recording(
    folder: str | Path,
    *,
    scene: str = "straight_road",
    frames: int = 10,
    size: tuple[int, int] = (240, 320),
    skipped: int = 20,
    seed: int = 0,
) -> None:
    """Records a drive of the planner in a folder with the layout of `format=frames`.

    Args:
        folder: the new folder.
        scene: the name of a scene, or the path of its file.
        frames: the number of frames.
        size: height and width of the pictures.
        skipped: steps before the first frame.
        seed: of the episode.
    """
    folder, street = Path(folder), load_scene(scene)
    camera = replace(street.camera, height_px=size[0], width_px=size[1])
    env = StreetEnv(replace(street, camera=camera), sensors=SENSORS)
    planner, poses, world_from_cam = Planner(), [], np.eye(4)
    for kind in ("depth", "flow"):
        (folder / kind).mkdir(parents=True)
    try:
        env.reset(seed=seed)
        for _ in range(skipped):
            env.drive(planner(env))
        for i in range(frames):
            seen, *_ = env.step(planner(env))
            write_png(folder / f"rgb/{i:06d}.png", seen["rgb"].transpose(1, 2, 0))
            np.save(folder / f"depth/{i:06d}.npy", seen["depth"][0])
            if i > 0:
                world_from_cam = world_from_cam @ seen["prev_from_curr"]
                depth, instance, motion = (
                    torch.from_numpy(seen[name])
                    for name in ("depth", "instance", "instance_motion")
                )
                raw, valid = rigid_flow(depth, instance, torch.as_tensor(env.K), motion)
                write_flo(folder / f"flow/{i:06d}.flo", raw.numpy(), valid[0].numpy())
            poses.append(world_from_cam)
        K = np.asarray(env.K, dtype=np.float64)
    finally:
        env.close()
    lines = (" ".join(f"{number:.9g}" for number in pose.ravel()) for pose in poses)
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    intrinsics = {"width": size[1], "height": size[0], "first_pixel_centre": 0.5}
    intrinsics |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    (folder / "intrinsics.json").write_text(json.dumps(intrinsics) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Writes ten frames of a street with people.")
    parser.add_argument("folder", nargs="?", default="street", help="the new folder (%(default)s)")
    make_recording(parser.parse_args().folder)
