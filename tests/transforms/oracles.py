"""What each representation must be, worked out pixel by pixel in plain Python floats."""

import math

import torch
from torch import Tensor

from tests.geometry.scenes import flow_pixel_by_pixel
from tests.transforms.fake_env import INTRINSICS, NUM_CLASSES, frame, moment

K = torch.tensor(INTRINSICS, dtype=torch.float64)


def raw(sensor: dict[str, Tensor]) -> Tensor:
    motions, instance = sensor["instance_motion"], sensor["instance"]
    return flow_pixel_by_pixel(sensor["depth"], K, motions, instance=instance).float()


def ego(sensor: dict[str, Tensor]) -> Tensor:
    return flow_pixel_by_pixel(sensor["depth"], K, sensor["prev_from_curr"]).float()


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


def inverted_opengl_pose(sensor: dict[str, Tensor]) -> Tensor:
    """Returns the pose with OpenCV's axes, were the env's pose world-to-camera with OpenGL's."""
    return torch.linalg.inv(sensor["world_from_cam"]) * torch.tensor([1, -1, -1, 1])


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
