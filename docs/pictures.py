"""Draws the pictures of the README and of the documentation: `make gallery`.

    python -m docs.pictures docs/images

`agent.gif` is a trained agent's drive. Of one step of a planner's drive, `strip.png` has the
representations side by side and `obj_scale.png` explains the scale of object flow. `transforms/`
has the output of each transform, for its page.
"""

import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from flowrep import Agent
from flowrep.experiment.film import OUTCOME_S, Film
from flowrep.geometry import ego_flow, unproject
from flowrep.scenes import load_scene
from flowrep.transforms import EstimatedFlow
from flowrep.viz import (
    DEPTH_RANGE_M,
    FLOW_SCALE_PX,
    classes_to_rgb,
    depth_note,
    depth_to_rgb,
    flow_note,
    flow_to_rgb,
    representation_strip,
    strip,
    write_png,
)

SIZE_PX = 160  # of the transforms' pictures
NOTES = {name: flow_note(scale) for name, scale in FLOW_SCALE_PX.items()}
NOTES |= dict.fromkeys(("depth", "z"), depth_note(DEPTH_RANGE_M))
PARTS = np.array([(235, 235, 235), (222, 40, 60), (46, 64, 196), (60, 160, 90)], dtype=np.uint8)


def main(folder: Path) -> None:
    """Writes all pictures into a folder."""
    maps, *_ = drive(load_scene("straight_road"), 561807780)
    chosen = maps[liveliest(maps, 6)]
    write_png(folder / "strip.png", representation_strip(chosen))
    write_png(folder / "obj_scale.png", three_ways(chosen))
    write_gif(folder / "agent.gif")
    scene = load_scene("h_shaped_pathways")
    camera = replace(scene.camera, height_px=SIZE_PX, width_px=SIZE_PX)
    maps, steps, K = drive(replace(scene, camera=camera), 1560023975)
    at = liveliest(maps, 5)
    for name, images in of_transforms(steps[at - 1], steps[at], maps[at - 1], maps[at], K).items():
        notes = {name: note for name, note in NOTES.items() if name in images}
        path = folder / "transforms" / f"{name}.png"
        write_png(path, strip(images, wheel_for=FLOW_SCALE_PX, notes=notes))


def drive(scene, seed):
    """Returns the maps and the sensors of each step of a planner's drive, and K."""
    film, steps = Film(Agent.load("planner", scene=asdict(scene), device="cpu")), []
    K = torch.as_tensor(film.street.K)
    frames, _ = film.drive({"episode_seed": seed}, lambda step: steps.append(step["sensor"][0]))
    film.close()
    return [frame.maps for frame in frames], steps, K


def liveliest(maps, beyond_m):
    """Returns the step with the most moving pixels, without those right in front of the camera."""
    moving = [int(((each["obj"] != 0) & (each["depth"] > beyond_m)).sum()) for each in maps]
    return moving.index(max(moving))


def three_ways(maps):
    """Returns raw and object flow at raw's scale, and object flow at its own."""
    raws, own = FLOW_SCALE_PX["raw"], FLOW_SCALE_PX["obj"]
    shown = {"raw": ("raw", raws), "obj, as raw": ("obj", raws), "obj, its own": ("obj", own)}
    images = {"RGB": maps["rgb"].numpy().transpose(1, 2, 0)}
    images |= {label: flow_to_rgb(maps[name], scale) for label, (name, scale) in shown.items()}
    notes = {label: flow_note(scale) for label, (_, scale) in shown.items()}
    return strip(images, wheel_for=shown, notes=notes)


def write_gif(path: Path, seed: int = 1, last: int = 72, every: int = 2) -> None:
    """Films the end of a trained agent's drive: the picture, the classes, and what it reads."""
    film = Film(Agent.load("pretrained", scene="straight_road", device="cpu"))
    film.tiles = {name: film.tiles[name] for name in ("rgb", "seg", "obj")}
    frames, episode = film.drive({"episode_seed": seed})
    film.close()
    images = [film.draw(frame) for frame in frames[-1 - last : -1 : every]]
    images.append(film.draw(frames[-1], episode))
    # One palette for all frames, with the rare colours too; without dithering: a sixth of the size.
    sample = np.concatenate([*images[::3], images[-1]])
    palette = Image.fromarray(sample).quantize(96, Image.Quantize.MAXCOVERAGE)
    first, *others = [Image.fromarray(each).quantize(palette=palette, dither=0) for each in images]
    durations = [1000 * every / episode.fps] * len(others) + [1000 * OUTCOME_S]
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0)


def of_transforms(step_before, step, before, now, K):
    """Returns the pictures of each transform's page, by label."""
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
    """Returns the flow that three motions of the camera cause."""
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
    """Returns ids coloured by the part of a person: body, left leg, right leg."""
    ids = instance[0].long()
    return PARTS[torch.where(ids > 0, (ids - 1) % 3 + 1, 0).numpy()]


def of_estimates(step_before, step, now, K):
    """Returns object flow, exact and from estimated flow, with the camera compensated or not."""
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
    """Returns depth along the axis, the length of the ray beyond it, and a z-buffer."""
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
    """Returns values from 0 to 1 as a grey picture."""
    return (255 * values[0].clamp(0, 1)).to(torch.uint8).numpy()[..., None].repeat(3, -1)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
