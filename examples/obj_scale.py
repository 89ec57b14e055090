"""Writes the picture that explains the scale of object flow: one frame, three ways to colour it.

python examples/obj_scale.py docs/images/obj_scale.png
"""

import sys

import torch

from flowrep.baselines.planner import Planner
from flowrep.envs import make_env, street_envs
from flowrep.viz import FLOW_SCALE_PX, flow_note, flow_to_rgb, strip, write_png
from flowrep.viz.film import film_episode


def main(path: str, seed: int = 2) -> None:
    env = make_env("straight_road", ["rgb"], keep_sensor=True, seed=seed)
    street, planner = street_envs(env)[0], Planner()

    def drive(tensordict):
        return tensordict.set("action", torch.tensor([planner(street)]))

    frames, _ = film_episode(env, drive)
    env.close()
    write_png(path, three_ways(liveliest(frames)))
    print(path)


def liveliest(frames):
    """Returns the step with most in motion of its own, but nobody right before the lens."""
    return max(frames, key=lambda maps: int(((maps["obj"] != 0) & (maps["depth"] > 6)).sum()))


def three_ways(maps):
    """Returns raw flow and object flow at raw's scale, and object flow at its own."""
    raws, own = FLOW_SCALE_PX["raw"], FLOW_SCALE_PX["obj"]
    shown = {"raw": ("raw", raws), "obj, as raw": ("obj", raws), "obj, its own": ("obj", own)}
    images = {"RGB": maps["rgb"].numpy().transpose(1, 2, 0)}
    images |= {label: flow_to_rgb(maps[name], scale) for label, (name, scale) in shown.items()}
    notes = {label: flow_note(scale) for label, (_, scale) in shown.items()}
    return strip(images, wheel_for=shown, notes=notes)


if __name__ == "__main__":
    main(sys.argv[1])
