"""Writes the README's strip: one step of a planner's drive, each representation side by side.

python examples/filmstrip.py docs/images/strip.png
"""

import sys

import torch

from flowrep.baselines.planner import Planner
from flowrep.envs import make_env, street_envs
from flowrep.viz import representation_strip, write_png
from flowrep.viz.film import film_episode


def main(path: str, seed: int = 2) -> None:
    env = make_env("straight_road", ["rgb"], keep_sensor=True, seed=seed)
    street, planner = street_envs(env)[0], Planner()

    def drive(tensordict):
        return tensordict.set("action", torch.tensor([planner(street)]))

    frames, outcome = film_episode(env, drive)
    env.close()
    # The step with most of the picture in motion of its own, but nobody right before the lens.
    chosen = max(frames, key=lambda maps: int(((maps["obj"] != 0) & (maps["depth"] > 6)).sum()))
    write_png(path, representation_strip(chosen))
    print(f"{path}: one of {len(frames)} steps of an episode that ended in {outcome}")


if __name__ == "__main__":
    main(sys.argv[1])
