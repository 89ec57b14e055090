"""What each representation must be, worked out pixel by pixel in plain Python floats."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tests.transforms.fake_env import INTRINSICS, NUM_CLASSES, frame, moment


def flow(depth: Tensor, motions: Tensor, instance: Tensor | None = None) -> Tensor:
    """Returns p_t - p_t' `[2, H, W]` of each pixel: there by `motions`, back through the camera."""
    (fx, _, cx), (_, fy, cy), _ = INTRINSICS
    height, width = depth.shape[-2:]
    out = torch.zeros(2, height, width)
    for j in range(height):
        for i in range(width):
            z = depth[0, j, i].item()
            if math.isnan(z):
                continue
            motion = motions if instance is None else motions[instance[0, j, i].item()]
            rows = motion.double().tolist()
            far = math.isinf(z)
            # A point at infinity is a direction: the translation does not move it.
            x, y, w = ((i + 0.5 - cx) / fx, (j + 0.5 - cy) / fy, 1.0)
            scale, moved = (1.0, 0.0) if far else (z, 1.0)
            px, py, pz = (
                sum(row[k] * scale * (x, y, w)[k] for k in range(3)) + moved * row[3]
                for row in rows[:3]
            )
            out[0, j, i] = (i + 0.5) - (fx * px / pz + cx)
            out[1, j, i] = (j + 0.5) - (fy * py / pz + cy)
    return out


def raw(sensor: dict[str, Tensor]) -> Tensor:
    return flow(sensor["depth"], sensor["instance_motion"], sensor["instance"])


def ego(sensor: dict[str, Tensor]) -> Tensor:
    return flow(sensor["depth"], sensor["prev_from_curr"])


def obj(sensor: dict[str, Tensor]) -> Tensor:
    return raw(sensor) - ego(sensor)


def valid(sensor: dict[str, Tensor]) -> Tensor:
    return ~sensor["depth"].isnan()


def seg(sensor: dict[str, Tensor]) -> Tensor:
    return sensor["semantic"]


def onehot(sensor: dict[str, Tensor]) -> Tensor:
    ids = sensor["semantic"][0]
    out = torch.zeros(NUM_CLASSES, *ids.shape)
    for j in range(ids.shape[0]):
        for i in range(ids.shape[1]):
            out[ids[j, i].item(), j, i] = 1.0
    return out


def depth(sensor: dict[str, Tensor], range_m: float = 100.0) -> Tensor:
    out = torch.zeros_like(sensor["depth"])
    for index, z in enumerate(sensor["depth"].flatten().tolist()):
        out.view(-1)[index] = 0.0 if math.isnan(z) else min(z / range_m, 1.0)
    return out


def rgb(sensor: dict[str, Tensor]) -> Tensor:
    return sensor["rgb"]


def stacked(of: str, sensor: dict[str, Tensor], k: int) -> Tensor:
    """Returns the last k maps of the moment's episode: `frame` can tell them all."""
    env, episode, step = moment(sensor["depth"])
    past = [max(step - age, 0) for age in range(k - 1, -1, -1)]
    return torch.cat([frame(env, episode, t)[of] for t in past], 0)
