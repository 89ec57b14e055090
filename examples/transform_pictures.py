"""Writes a picture of what each transform gives, for its page in docs/.

python examples/transform_pictures.py docs/images/transforms
"""

import sys
from pathlib import Path

import numpy as np
import torch

from flowrep.envs import Planner, make_env, streets
from flowrep.experiment.recording import film_episode
from flowrep.viz import FLOW_SCALE_PX, classes_to_rgb, depth_to_rgb, flow_to_rgb, write_png

SCENE, SEED, STEP = "h_shaped_pathways", 4, 24


def main(folder: str) -> None:
    env = make_env(SCENE, ["rgb"], keep_sensor=True, seed=SEED)
    street, planner = streets(env)[0], Planner()

    def drive(tensordict):
        return tensordict.set("action", torch.tensor([planner(street)]))

    frames, _ = film_episode(env, drive)
    env.close()
    before, now = frames[STEP - 1], frames[STEP]
    pictures = {
        "rgb": now["rgb"].numpy().transpose(1, 2, 0),
        "seg": classes_to_rgb(now["semantic"]),
        "depth": depth_to_rgb(now["depth"]),
        "seg2": beside(classes_to_rgb(before["semantic"]), classes_to_rgb(now["semantic"])),
    }
    for name in ("raw", "ego", "obj"):
        pictures[name] = flow_to_rgb(now[name], FLOW_SCALE_PX[name])
    pictures["factors"] = beside(*(pictures[name] for name in ("raw", "ego", "obj")))
    Path(folder).mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        write_png(Path(folder) / f"{name}.png", enlarged(picture))
        print(Path(folder) / f"{name}.png")


def beside(*pictures: np.ndarray) -> np.ndarray:
    gap = np.full((pictures[0].shape[0], 2, 3), 255, dtype=np.uint8)
    return np.concatenate([part for picture in pictures for part in (picture, gap)][:-1], axis=1)


def enlarged(picture: np.ndarray, factor: int = 3) -> np.ndarray:
    return picture.repeat(factor, 0).repeat(factor, 1)


if __name__ == "__main__":
    main(sys.argv[1])
