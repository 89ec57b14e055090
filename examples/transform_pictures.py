"""Writes a picture of each transform's output, for its page in docs/.

python examples/transform_pictures.py docs/images/transforms
"""

import sys
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from flowrep.experiment.film import Film
from flowrep.geometry import ego_flow, unproject
from flowrep.policies import load_agent
from flowrep.scenes import load_scene
from flowrep.transforms import EstimatedFlow
from flowrep.viz import (
    DEPTH_RANGE_M,
    FLOW_SCALE_PX,
    classes_to_rgb,
    depth_bar,
    depth_to_rgb,
    flow_note,
    flow_to_rgb,
    strip,
    write_png,
)

SCENE, SEED, SIZE_PX = "h_shaped_pathways", 1560023975, 160
NOTES = {name: flow_note(scale) for name, scale in FLOW_SCALE_PX.items()}
NOTES |= {"depth": partial(depth_bar, DEPTH_RANGE_M), "z": partial(depth_bar, DEPTH_RANGE_M)}
PARTS = np.array([(235, 235, 235), (222, 40, 60), (46, 64, 196), (60, 160, 90)], dtype=np.uint8)


def main(folder: str) -> None:
    scene = load_scene(SCENE)
    camera = replace(scene.camera, height_px=SIZE_PX, width_px=SIZE_PX)
    scene = asdict(replace(scene, camera=camera))
    film = Film(load_agent("planner", scene=scene, device="cpu", num_envs=1, num_workers=0))
    K, steps = torch.as_tensor(film.street.K), []
    frames, _ = film.drive(
        {"episode_seed": SEED}, lambda tensordict: steps.append(tensordict["sensor"][0])
    )
    film.close()
    maps = [frame.maps for frame in frames]
    # The step with the most motion, but nobody right in front of the camera.
    motion = [int(((frame["obj"] != 0) & (frame["depth"] > 5)).sum()) for frame in maps]
    at = max(range(1, len(maps)), key=lambda i: motion[i])
    for name, images in pictures(steps[at - 1], steps[at], maps[at - 1], maps[at], K).items():
        path = Path(folder) / f"{name}.png"
        notes = {name: note for name, note in NOTES.items() if name in images}
        write_png(path, strip(images, wheel_for=FLOW_SCALE_PX, notes=notes))
        print(path)


def pictures(step_before, step, before, now, K):
    """Returns the pictures of each page, by label."""
    flows = {name: flow_to_rgb(now[name], scale) for name, scale in FLOW_SCALE_PX.items()}
    rgb = now["rgb"].numpy().transpose(1, 2, 0)
    return {
        "rgb": {"rgb": rgb},
        "segmentation": {"rgb": rgb, "seg": classes_to_rgb(now["seg"])},
        "depth": {"rgb": rgb, "depth": depth_to_rgb(now["depth"])},
        "frame_stack": {
            "seg2, first": classes_to_rgb(before["seg"]),
            "seg2, second": classes_to_rgb(now["seg"]),
        },
        "raw_flow": {"rgb": rgb, "raw": flows["raw"]},
        "flow_factorize": {name: flows[name] for name in ("raw", "ego", "obj")},
        "camera_motion": of_camera_motions(step["depth"], K),
        "instance_ids": {"rgb": rgb, "ids: body, left, right leg": of_parts(step["instance"])},
        "instance_motion": {
            "every row is row 0": flow_to_rgb(now["ego"], FLOW_SCALE_PX["raw"]),
            "a row an instance": flows["raw"],
            "their difference": flows["obj"],
        },
        "estimated_flow": of_estimates(step_before, step, now, K),
        "adapt": of_depth_kinds(step["depth"], K),
    }


def of_camera_motions(depth, K):
    ahead, aside, turned = (torch.eye(4) for _ in range(3))
    ahead[2, 3], aside[0, 3] = 0.8, 0.3
    angle = torch.tensor(0.05)
    turned[0, 0] = turned[2, 2] = angle.cos()
    turned[0, 2], turned[2, 0] = angle.sin(), -angle.sin()
    motions = {"0.8 m ahead": ahead, "0.3 m to the right": aside, "3° to the right": turned}
    return {
        label: flow_to_rgb(ego_flow(depth, K.float(), motion).flow, FLOW_SCALE_PX["ego"])
        for label, motion in motions.items()
    }


def of_parts(instance):
    ids = instance[0].long()
    return PARTS[torch.where(ids > 0, (ids - 1) % 3 + 1, 0).numpy()]


def of_estimates(step_before, step, now, K):
    pair = torch.cat([step_before["rgb"], step["rgb"]])
    size = {"picture_scale": pair.shape[-1] // SIZE_PX}
    plain = EstimatedFlow(**size).compute(pair)[0]
    motion = step["instance_motion"][0]
    compensated = EstimatedFlow(intrinsics=K, **size).compute(pair, step["depth"], motion)[0]
    return {
        "obj, exact": flow_to_rgb(now["obj"], FLOW_SCALE_PX["obj"]),
        "raw by DIS": flow_to_rgb(plain, FLOW_SCALE_PX["raw"]),
        "obj from it": flow_to_rgb(plain - now["ego"], FLOW_SCALE_PX["obj"]),
        "obj, compensated": flow_to_rgb(compensated - now["ego"], FLOW_SCALE_PX["obj"]),
    }


def of_depth_kinds(depth, K):
    points = unproject(depth.double(), K)
    ray = points.norm(dim=-1)[None]
    error = torch.where(depth.isinf(), 0.0, ray - depth.double())
    near_m, far_m = 0.2, 300.0
    z_buffer = far_m * (depth.double() - near_m) / (depth.double() * (far_m - near_m))
    z_buffer = torch.where(depth.isinf(), 1.0, z_buffer)
    return {
        "z": depth_to_rgb(depth),
        "ray length - z, to 10 m": grey(error / 10.0),
        "z-buffer": grey(z_buffer),
    }


def grey(values):
    return (255 * values[0].clamp(0, 1)).to(torch.uint8).numpy()[..., None].repeat(3, -1)


if __name__ == "__main__":
    main(sys.argv[1])
