"""Draws a sheet of close-ups of all kinds of objects and of people in a street.

python examples/shapes.py docs/images/shapes.png
"""

import sys
from dataclasses import replace

from flowrep.envs import StreetEnv
from flowrep.scenes import load_scene
from flowrep.scenes.scene import Obstacle, PedestrianGroup, Walk
from flowrep.viz import contact_sheet, strip, write_png

SIZES = {
    "car": (4.2, 1.8, 1.45),
    "tree": (0.4, 0.4, 5.5),
    "fence": (3.0, 0.1, 1.1),
    "traffic_light": (0.2, 0.2, 3.6),
    "lamp_post": (0.2, 0.2, 5.0),
}


def picture(scene, *, distance_m, turn_deg=0.0, kind=None, person=False, episode=0):
    ahead = (distance_m, 0.0)
    if kind is not None:
        scene = replace(scene, obstacles=(Obstacle(kind, ahead, turn_deg, SIZES[kind]),))
    if person:
        walk = Walk("points", points_m=((distance_m, -1.0), (distance_m, 1.0)))
        group = PedestrianGroup("one", 1, 0.0, walk)
        scene = replace(scene, pedestrian_groups=(group,))
    env = StreetEnv(scene, sensors=("rgb",))
    observation, _ = env.reset(options={"episode_seed": episode})
    env.close()
    return observation["rgb"].transpose(1, 2, 0)


def main(path: str) -> None:
    road = load_scene("straight_road")
    camera = replace(road.camera, height_px=200, width_px=200, fov_deg=50.0, pitch_deg=-4.0)
    every = (*road.categories, "tree", "fence", "car", "traffic_light")
    road = replace(road, camera=camera, pedestrian_groups=(), categories=every)
    rows = [
        {
            "car": picture(road, kind="car", distance_m=7.0, turn_deg=35.0),
            "car from behind": picture(road, kind="car", distance_m=7.0, turn_deg=-20.0),
            "tree": picture(road, kind="tree", distance_m=10.0),
            "lamp post": picture(road, kind="lamp_post", distance_m=15.0),
        },
        {
            "fence": picture(road, kind="fence", distance_m=4.0, turn_deg=65.0),
            "traffic light": picture(road, kind="traffic_light", distance_m=6.5),
            "person, walking": picture(road, person=True, distance_m=3.6, episode=1),
            "person, later": picture(road, person=True, distance_m=3.6, episode=4),
        },
    ]
    write_png(path, contact_sheet(strip(row) for row in rows))


if __name__ == "__main__":
    main(sys.argv[1])
