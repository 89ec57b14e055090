"""The usual mistakes about poses, depth and flow, and how to correct each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from flowrep.geometry import adapt_pose, invert_rigid, z_from_ray_length


@dataclass(frozen=True)
class Mistake:
    """One usual mistake.

    Attributes:
        says: what the data would have to be, to complete "if ...".
        options: the options of `frames` that say so, as on a command line.
        poses: returns the correct poses from the given ones, or None.
        depth: returns the correct depth from depth and K, or None.
        flow: returns the correct raw flow from the given flow, or None.
    """

    says: str
    options: str
    poses: Callable[[Tensor], Tensor] | None = None
    depth: Callable[[Tensor, Tensor], Tensor] | None = None
    flow: Callable[[Tensor], Tensor] | None = None


def _axes(name: Any) -> Callable[[Tensor], Tensor]:
    return lambda pose: adapt_pose(pose, axes=name, check=False)


def _axes_undone(name: Any) -> Callable[[Tensor], Tensor]:
    given_from_opencv = adapt_pose(torch.eye(4), axes=name)
    return lambda pose: pose @ given_from_opencv.mT


def _inverted(then: Callable[[Tensor], Tensor] = lambda pose: pose) -> Callable[[Tensor], Tensor]:
    """Corrects poses that are world-to-camera, of a camera whose axes `then` corrects."""
    return lambda pose: then(invert_rigid(pose))


def _ray_from_z(depth: Tensor, K: Tensor) -> Tensor:
    ray = depth.square() / z_from_ray_length(depth, K)
    return torch.where(depth.isinf(), depth, ray)  # the sky stays at infinity


def _unit(factor: float) -> Callable[[Tensor, Tensor], Tensor]:
    return lambda depth, K: factor * depth


MISTAKES: Mapping[str, Mistake] = {
    "poses_inverted": Mistake(
        "the poses are world-to-camera (or were inverted once too often)",
        "pose_direction=world_to_camera",
        poses=_inverted(),
    ),
    "flow_sign": Mistake(
        "the flow points back to the previous frame (or the frames are in the wrong order)",
        "flow_direction=backward",
        flow=lambda raw: -raw,
    ),
    "flow_channels": Mistake(
        "the flow is (row, column)", "flow_channels=row_column", flow=lambda raw: raw.flip(0)
    ),
    "axes_opengl": Mistake(
        "the camera's axes are OpenGL's (or were turned once too often)",
        "pose_axes=opengl",
        poses=_axes("opengl"),
    ),
    "axes_ned": Mistake(
        "the camera's axes are north-east-down", "pose_axes=ned", poses=_axes("ned")
    ),
    "axes_x_forward": Mistake(
        "the camera's axes are x forward, z up",
        "pose_axes=x_forward_z_up",
        poses=_axes("x_forward_z_up"),
    ),
    "axes_not_ned": Mistake(
        "the camera's axes are OpenCV's, not north-east-down",
        "pose_axes=opencv",
        poses=_axes_undone("ned"),
    ),
    "axes_not_x_forward": Mistake(
        "the camera's axes are OpenCV's, not x forward",
        "pose_axes=opencv",
        poses=_axes_undone("x_forward_z_up"),
    ),
    "poses_inverted_opengl": Mistake(
        "the poses are world-to-camera with OpenGL's axes",
        "pose_direction=world_to_camera pose_axes=opengl",
        poses=_inverted(_axes("opengl")),
    ),
    "ray_length": Mistake(
        "depth is the length of the ray, not z", "depth_kind=ray_length", depth=z_from_ray_length
    ),
    "not_ray_length": Mistake(
        "depth is z already, not the length of the ray", "depth_kind=z", depth=_ray_from_z
    ),
    **{
        f"depth_times_{factor:g}": Mistake(
            f"depth in metres is {factor:g} times as large", "depth_unit_m", depth=_unit(factor)
        )
        for factor in (0.001, 0.01, 0.1, 0.2, 5.0, 10.0, 100.0, 1000.0)
    },
}


def on_command_line(name: str) -> str:
    """Returns the options of `frames` that correct a mistake, as they are typed."""
    options = MISTAKES[name].options.split()
    if name.startswith("depth_times_"):
        return f"format.{options[0]} times {name.removeprefix('depth_times_')}"
    return " ".join(f"format.{option}" for option in options)
