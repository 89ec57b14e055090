"""Writes three pictures of the README and the documentation.

python examples/filmstrip.py docs/images

`agent.gif` is a trained agent's drive; of one step of a planner's, `strip.png` has each
representation side by side and `obj_scale.png` explains the scale of object flow.
"""

import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
from PIL import Image

from flowrep import pretrained
from flowrep.experiment.film import OUTCOME_S, Film
from flowrep.policies import load_agent
from flowrep.scenes import load_scene
from flowrep.viz import (
    FLOW_SCALE_PX,
    flow_note,
    flow_to_rgb,
    representation_strip,
    strip,
    write_png,
)


def main(folder: Path, seed: int = 561807780) -> None:
    scene = asdict(load_scene("straight_road"))
    film = Film(load_agent("planner", scene=scene, device="cpu", num_envs=1, num_workers=0))
    frames, episode = film.drive({"episode_seed": seed})
    film.close()
    chosen = liveliest([frame.maps for frame in frames])
    write_png(folder / "strip.png", representation_strip(chosen))
    write_png(folder / "obj_scale.png", three_ways(chosen))
    print(f"{folder}: one of {len(frames)} steps of an episode that ended in {episode.outcome}")
    write_gif(folder / "agent.gif")


def write_gif(path: Path, seed: int = 1, last: int = 72, every: int = 2) -> None:
    """Films the end of a trained agent's drive: the picture, the classes, and what it reads."""
    film = Film(pretrained.load("straight_road", device="cpu"))
    film.tiles = {name: film.tiles[name] for name in ("rgb", "seg", "obj")}
    frames, episode = film.drive({"episode_seed": seed})
    film.close()
    images = [film.draw(frame) for frame in frames[-1 - last : -1 : every]]
    images.append(film.draw(frames[-1], episode))
    # one palette for all frames, with the rare colours too; no dithering: a sixth of the size
    sample = np.concatenate([*images[::3], images[-1]])
    palette = Image.fromarray(sample).quantize(96, Image.Quantize.MAXCOVERAGE)
    first, *others = [Image.fromarray(each).quantize(palette=palette, dither=0) for each in images]
    durations = [1000 * every / episode.fps] * len(others) + [1000 * OUTCOME_S]
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0)
    print(f"{path}: the last {last} of {len(frames)} steps, which end in {episode.outcome}")


def liveliest(frames):
    """Returns the step with the most moving pixels, but nobody right in front of the camera."""
    return max(frames, key=lambda maps: int(((maps["obj"] != 0) & (maps["depth"] > 6)).sum()))


def three_ways(maps):
    """Returns raw and object flow at raw's scale, and object flow at its own."""
    raws, own = FLOW_SCALE_PX["raw"], FLOW_SCALE_PX["obj"]
    shown = {"raw": ("raw", raws), "obj, as raw": ("obj", raws), "obj, its own": ("obj", own)}
    images = {"RGB": maps["rgb"].numpy().transpose(1, 2, 0)}
    images |= {label: flow_to_rgb(maps[name], scale) for label, (name, scale) in shown.items()}
    notes = {label: flow_note(scale) for label, (_, scale) in shown.items()}
    return strip(images, wheel_for=shown, notes=notes)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
