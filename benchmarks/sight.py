"""Visibility of people by distance: the pixels they cover and the share of frames without any.

A planner drives; every fourth frame is rendered by each camera. People within 5 m of the line
straight ahead are counted, including those hidden or outside the field of view.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrep.baselines import Planner
from flowrep.envs import StreetEnv
from flowrep.scenes import Scene, load_scene, scene_names
from flowrep.scenes.pedestrians import PARTS

CAMERAS = ((48, 48, 90), (48, 48, 60), (64, 64, 60), (84, 84, 90), (84, 84, 60), (48, 84, 60))
BINS_M = ((5, 10), (10, 15), (15, 20), (20, 25), (25, 30))
ASIDE_M = 5.0
EVERY = 4


def states(scene: Scene, episodes: int) -> Iterator[dict[str, Any]]:
    """Yields the env's state every few frames of a planner's drives."""
    env, planner = StreetEnv(scene, sensors=()), Planner()
    for episode in range(episodes):
        env.reset(seed=episode if not episode else None)
        ended = False
        while not ended:
            if env.episode.steps % EVERY == 0:
                yield env.get_state()
            _, _, ended, _, _ = env.step(planner(env))
    env.close()


def seen(env: StreetEnv, state: dict[str, Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns distances in metres to people near the line ahead, and the pixels they cover."""
    observation, _ = env.set_state(state)
    vehicle, poses = env.episode.now.vehicle, env.episode.poses
    away = poses[:, :2] - (vehicle.x_m, vehicle.y_m)
    cosine, sine = np.cos(vehicle.yaw_rad), np.sin(vehicle.yaw_rad)
    ahead_m = away @ (cosine, sine) - env.scene.camera.mount_forward_m
    aside_m = away @ (-sine, cosine)
    count = np.bincount(observation["instance"].ravel(), minlength=1 + len(PARTS) * len(poses))
    pixels = count[1:].reshape(len(poses), len(PARTS)).sum(1)
    is_near = np.abs(aside_m) <= ASIDE_M
    return ahead_m[is_near], pixels[is_near]


def main() -> None:
    """Prints a table for each scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", default=list(scene_names()))
    parser.add_argument("--episodes", type=int, default=20)
    arguments = parser.parse_args()
    print("| scene | camera |" + "".join(f" {low}-{high} m |" for low, high in BINS_M))
    print("| --- " * (2 + len(BINS_M)) + "|")
    for name in arguments.scenes:
        scene = load_scene(name)
        drive = list(states(scene, arguments.episodes))
        for height_px, width_px, fov_deg in CAMERAS:
            camera = replace(
                scene.camera, height_px=height_px, width_px=width_px, fov_deg=float(fov_deg)
            )
            env = StreetEnv(replace(scene, camera=camera), sensors=("instance",))
            pairs = [seen(env, state) for state in drive]
            ahead_m, pixels = (np.concatenate(part) for part in zip(*pairs, strict=True))
            cells = []
            for low, high in BINS_M:
                inside = pixels[(ahead_m >= low) & (ahead_m < high)]
                if len(inside):
                    cells.append(f"{inside.mean():.1f} px, {np.mean(inside == 0):.0%}")
                else:
                    cells.append("nobody")
            print(f"| {name} | {width_px} × {height_px}, {fov_deg}° | " + " | ".join(cells) + " |")
            env.close()


if __name__ == "__main__":
    main()
