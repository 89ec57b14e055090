"""Writes three pictures of the README and the documentation.

python examples/filmstrip.py docs/images

`agent.gif` is a trained agent's drive; of one step of a planner's, `strip.png` has each
representation side by side and `obj_scale.png` explains the scale of object flow.
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from flowrep import pretrained
from flowrep.baselines import BaselinePolicy
from flowrep.envs import make_env
from flowrep.experiment.film import film_episode, make_filmed
from flowrep.viz import (
    FLOW_SCALE_PX,
    flow_note,
    flow_to_rgb,
    representation_strip,
    strip,
    write_png,
)


def main(folder: Path, seed: int = 561807780) -> None:
    env = make_filmed(partial(make_env, "straight_road"), {})
    frames, episode = film_episode(env, BaselinePolicy("planner", env), {"episode_seed": seed})
    env.close()
    chosen = liveliest(frames)
    write_png(folder / "strip.png", representation_strip(chosen))
    write_png(folder / "obj_scale.png", three_ways(chosen))
    print(f"{folder}: one of {len(frames)} steps of an episode that ended in {episode.outcome}")
    write_gif(folder / "agent.gif")


def write_gif(path: Path, seed: int = 1, steps: slice = slice(20, 92, 2)) -> None:
    """Films what a trained agent sees, beside the picture and the classes, which it doesn't."""
    agent = pretrained.load("straight_road", device="cpu")
    env = make_filmed(agent.make_env, agent.config.representations)
    frames, episode = film_episode(env, agent.policy, {"episode_seed": seed})
    env.close()
    shown = [{name: maps[name] for name in ("rgb", "semantic", "obj")} for maps in frames[steps]]
    images = [representation_strip(maps) for maps in shown]
    # one palette for all frames, with the rare colours too; no dithering: a sixth of the size
    palette = Image.fromarray(np.concatenate(images[::3])).quantize(96, Image.Quantize.MAXCOVERAGE)
    first, *others = [Image.fromarray(each).quantize(palette=palette, dither=0) for each in images]
    duration = 1000 * steps.step / episode.fps
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0)
    print(f"{path}: {len(images)} of {len(frames)} steps, which end in {episode.outcome}")


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
