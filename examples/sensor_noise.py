"""Draws the effect of sensor noise on object flow in a static scene, where it should be 0.

A camera drives at 10 m/s and 12 frames/s over a plane between two walls. Each picture shows the
length of object flow under one kind of noise; all have the same scale in pixels.

python examples/sensor_noise.py docs/images/sensor_noise.png
"""

import sys

import matplotlib

matplotlib.use("Agg")
import torch
from matplotlib import pyplot as plt
from tensordict import TensorDict
from torchrl.envs.transforms import Compose

from flowrep.geometry import ego_flow, intrinsics_from_fov
from flowrep.transforms import FlowFactorize, SensorNoise

HEIGHT, WIDTH = 84, 112
K = intrinsics_from_fov(90.0, axis="horizontal", height=HEIGHT, width=WIDTH)
CAMERA_HEIGHT_M, WALL_M, HOUSE_M = 1.6, 6.0, 40.0  # above the plane; to each side; ahead
FULL_SCALE_PX = 0.5

NOISE = {
    "no noise": {},
    "depth, 0.01 z²": {"depth_sigma_per_m": 0.01},
    "depth, 10 % holes": {"depth_dropout": 0.1},
    "drift, 1 cm a step": {"drift_m": 0.01},
    "drift, 0.1° a step": {"drift_rad": 0.1 * torch.pi / 180},
    "flow, 0.1 px": {"flow_sigma_px": 0.1},
}


def main(path: str) -> None:
    sensor = street()
    raw = ego_flow(sensor["depth"], K, sensor["prev_from_curr"]).flow  # exact, as nothing moves
    figure, axes = plt.subplots(2, 3, figsize=(9.6, 5.4), layout="constrained")
    for axis, (name, options) in zip(axes.flat, NOISE.items()):
        noise = SensorNoise(sensors=["depth", "motion", "flow"], **options)
        split = FlowFactorize(K, outputs=["obj", "valid"])
        td = Compose(noise, split)(TensorDict({"sensor": sensor.clone(), "raw": raw.clone()}))
        length = td["obj"].norm(dim=0)
        shown = length.where(td["valid"][0], torch.nan)  # holes stay white
        picture = axis.imshow(
            shown, interpolation="nearest", vmin=0.0, vmax=FULL_SCALE_PX, cmap="magma"
        )
        known = length[td["valid"][0]]
        axis.set_title(f"{name}\nmean {known.mean():.3f}, 99 % below {known.quantile(0.99):.2f} px")
        axis.set_axis_off()
    figure.colorbar(picture, ax=axes, label="length of obj, pixels a step", extend="max")
    figure.savefig(path, dpi=80)
    print(path)


def street() -> TensorDict:
    """Returns depth of a plane, two walls and a house, and a camera motion of 10/12 m ahead."""
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    plane = torch.where(y > 0, CAMERA_HEIGHT_M / y, torch.inf)
    walls = WALL_M / x.abs()
    depth = torch.minimum(torch.minimum(plane, walls), torch.tensor(HOUSE_M))
    prev_from_curr = torch.eye(4)
    prev_from_curr[2, 3] = 10.0 / 12.0
    return TensorDict({"depth": depth.unsqueeze(0), "prev_from_curr": prev_from_curr})


if __name__ == "__main__":
    main(*sys.argv[1:])
