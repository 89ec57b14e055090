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


def onehot(sensor: dict[str, Tensor]) -> Tensor:
    return torch.cat([sensor["semantic"] == c for c in range(NUM_CLASSES)]).float()


def depth(sensor: dict[str, Tensor], range_m: float = 100.0) -> Tensor:
    out = torch.zeros_like(sensor["depth"])
    for index, z in enumerate(sensor["depth"].flatten().tolist()):
        out.view(-1)[index] = 0.0 if math.isnan(z) else min(z / range_m, 1.0)
    return out


def stacked(of: str, sensor: dict[str, Tensor], k: int) -> Tensor:
    """Returns the last k maps of the moment's episode: `frame` can tell them all."""
    env, episode, step = moment(sensor["depth"])
    past = [max(step - age, 0) for age in range(k - 1, -1, -1)]
    return torch.cat([frame(env, episode, t)[of] for t in past], 0)


def ray_length_to_z(sensor: dict[str, Tensor]) -> Tensor:
    """Returns z, were the env's depth the length of rays."""
    (fx, _, cx), (_, fy, cy), _ = INTRINSICS
    out = sensor["depth"].clone()
    for j in range(out.shape[-2]):
        for i in range(out.shape[-1]):
            x, y = (i + 0.5 - cx) / fx, (j + 0.5 - cy) / fy
            out[0, j, i] /= math.sqrt(x * x + y * y + 1)
    return out


def opengl_pose(sensor: dict[str, Tensor]) -> Tensor:
    """Returns the pose with OpenCV's axes, were the env's pose one with OpenGL's."""
    return sensor["world_from_cam"] * torch.tensor([1, -1, -1, 1])


def rows_backward(sensor: dict[str, Tensor]) -> Tensor:
    """Returns flow, were the env's raw flow backward with rows first; nan where it is unknown."""
    return torch.where(valid(sensor), -raw(sensor)[[1, 0]], math.nan)


def rows_of_classes(sensor: dict[str, Tensor], bodies: list[int]) -> Tensor:
    """Returns rows of bodies, were the env's classes segmentation ids."""
    ids = sensor["semantic"].flatten().tolist()
    rows = [1 + bodies.index(i) if i in bodies else 0 for i in ids]
    return torch.tensor(rows, dtype=torch.uint8).reshape(sensor["semantic"].shape)


def sensor_map(name: str, sensor: dict[str, Tensor]) -> Tensor:
    return sensor[name]


def hole(sensor: dict[str, Tensor]) -> Tensor:
    return torch.full_like(sensor["depth"], math.nan)


def brightening(first: Tensor, second: Tensor) -> Tensor:
    """An estimator of flow worked by hand: by how much the first picture is brighter."""
    return first[:, :2].float() - second[:, :2].float()


def minus_one_but_at_resets(sensor: dict[str, Tensor]) -> Tensor:
    """Returns flow by `brightening`, as the env's pictures brighten by 1 a step."""
    # brightening(current, previous) = 1, negated; the pair swapped would give +1.
    step = int(sensor["rgb"][0, 0, 0])
    return torch.full((2, *sensor["rgb"].shape[-2:]), -1.0 if step else 0.0)


def same_bits(a: Tensor, b: Tensor) -> bool:
    """Returns whether two tensors are equal, holes (nan) included."""
    return torch.equal(a.isnan(), b.isnan()) and torch.equal(a.nan_to_num(), b.nan_to_num())
