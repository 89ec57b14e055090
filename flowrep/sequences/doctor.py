"""The convention doctor: detects poses, depth or flow in another convention than assumed.

A wrong convention raises no error and gives wrong flow. In most recordings, most of the picture is
static, and there raw flow is ego flow, so that the median of |raw - ego| is small. If it is not,
the doctor computes ego flow again under each of the usual mistakes, and names the one that would
remove most of the residual.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flowrep.geometry import adapt_pose, ego_flow, invert_rigid, relative_motion, z_from_ray_length


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


# Residuals below these are normal: rounding of pixels, of estimators, of poses.
_SMALL_PX, _SMALL_SHARE = 0.05, 0.05
_SHRINKS = 0.5
_LEAST_RAW_PX = 0.25  # pairs that hardly move say nothing
_SAMPLED_PIXELS = 6000


@dataclass(frozen=True)
class Diagnosis:
    """The doctor's findings.

    Attributes:
        pairs: the number of pairs of frames that moved enough to be examined.
        raw_px: median length of raw flow, the mean over the pairs.
        residual_px: median of |raw - ego|, the mean over the pairs.
        rivals_px: `residual_px` under each of `MISTAKES`.
        suspects: the mistakes that would shrink the residual by half, the likeliest first, and
            others that would do as well.
    """

    pairs: int
    raw_px: float
    residual_px: float
    rivals_px: dict[str, float]
    suspects: tuple[str, ...]

    @property
    def words(self) -> str:
        """The diagnosis in a sentence or two."""
        if not self.pairs:
            return "conventions could not be checked: hardly anything moves"
        medians = (
            f"|raw - ego| is {self.residual_px:.2f} px, raw flow {self.raw_px:.2f} px (medians)"
        )
        if not self.suspects:
            if self.residual_px > _SHRINKS * self.raw_px:
                return (
                    f"ego flow does not explain the raw flow: {medians}. No usual mistake of "
                    "conventions would halve that: are intrinsics, poses and pictures of one "
                    "recording, and does most of the picture stand still?"
                )
            return f"conventions look right: {medians}"
        told = "; or ".join(
            f"{self.rivals_px[name]:.2f} px if {MISTAKES[name].says} "
            f"(frames: {on_command_line(name)})"
            for name in self.suspects
        )
        return f"a convention looks wrong: {medians}. It would be {told}"


@dataclass
class Doctor:
    """Examines pairs of frames, one after the other, and gives a diagnosis.

    >>> depth = torch.full((1, 8, 10), 4.0)
    >>> K = torch.tensor([[20.0, 0.0, 5.0], [0.0, 20.0, 4.0], [0.0, 0.0, 1.0]])
    >>> before, now = torch.eye(4).double(), torch.eye(4).double()
    >>> now[0, 3] = 0.5  # the camera went to the right: all streams by 20 * 0.5 / 4 to the left
    >>> raw = torch.tensor([2.5, 0.0]).reshape(2, 1, 1).expand(2, 8, 10)  # but this says right
    >>> doctor = Doctor()
    >>> doctor.look(raw, depth, K, before, now)
    >>> "flow_sign" in doctor.diagnosis().suspects
    True
    """

    _residuals: list[Tensor] = field(default_factory=list)
    _raw_px: list[float] = field(default_factory=list)

    @property
    def pairs(self) -> int:
        """The number of pairs that moved enough to be examined."""
        return len(self._raw_px)

    @torch.no_grad()
    def look(
        self,
        raw: Tensor,
        depth: Tensor,
        K: Tensor,
        world_from_prev: Tensor,
        world_from_curr: Tensor,
        *,
        static: Tensor | None = None,
    ) -> None:
        """Examines a pair of frames, unless hardly anything moves in it.

        Args:
            raw: `[2, H, W]`, pixels per step, assumed p_t - p_t' on the current grid; nan unknown.
            depth: `[1, H, W]`, of the current frame, assumed z in metres.
            K: `[3, 3]`, pixels.
            world_from_prev: `[4, 4]`, assumed camera-to-world with OpenCV's axes.
            world_from_curr: `[4, 4]`, the same for the current frame.
            static: `[1, H, W]` bool, pixels known to be static; without it most of the picture
                has to be.
        """
        raw, depth, K, known, step = _sampled(raw, depth, K, static)
        raw_px = step * _median_length(raw, known)
        if not raw_px >= _LEAST_RAW_PX:
            return
        poses = world_from_prev.double(), world_from_curr.double()
        self._raw_px.append(raw_px)
        self._residuals.append(step * _residuals(raw, depth, K, poses, known))

    def diagnosis(self) -> Diagnosis:
        """Returns the diagnosis from all pairs so far."""
        if not self.pairs:
            return Diagnosis(0, float("nan"), float("nan"), {}, ())
        residual, *rivals = torch.stack(self._residuals).mean(0).tolist()
        raw_px = float(np.mean(self._raw_px))
        rivals_px = dict(zip(MISTAKES, rivals))
        suspects: tuple[str, ...] = ()
        if residual > max(_SMALL_PX, _SMALL_SHARE * raw_px):
            least = min(rivals)
            if least <= _SHRINKS * residual:
                as_good = 1.2 * least + 0.01
                ranked = sorted(rivals_px, key=lambda name: rivals_px[name])
                suspects = tuple(name for name in ranked if rivals_px[name] <= as_good)
        return Diagnosis(self.pairs, raw_px, residual, rivals_px, suspects)


def diagnose(
    raw: Tensor,
    depth: Tensor,
    K: Tensor,
    world_from_prev: Tensor,
    world_from_curr: Tensor,
    *,
    static: Tensor | None = None,
) -> Diagnosis:
    """Returns the diagnosis from a single pair of frames, see `Doctor.look`."""
    doctor = Doctor()
    doctor.look(raw, depth, K, world_from_prev, world_from_curr, static=static)
    return doctor.diagnosis()


def _residuals(
    raw: Tensor, depth: Tensor, K: Tensor, poses: tuple[Tensor, Tensor], known: Tensor
) -> Tensor:
    """Returns the median of |raw - ego| as given, then under each mistake."""
    residuals = []
    for mistake in (None, *MISTAKES.values()):
        there, z, flow = poses, depth, raw
        if mistake is not None and mistake.poses:
            there = mistake.poses(poses[0]), mistake.poses(poses[1])
        if mistake is not None and mistake.depth:
            z = mistake.depth(depth, K)
        if mistake is not None and mistake.flow:
            flow = mistake.flow(raw)
        ego, valid = ego_flow(z, K, relative_motion(*there))
        # A convention does not explain the points that it puts behind the camera.
        left = torch.where(valid, flow - ego, torch.inf)
        residuals.append(_median_length(left, known))
    return torch.tensor(residuals, dtype=torch.float64).clamp(max=1e6)


def _sampled(
    raw: Tensor, depth: Tensor, K: Tensor, static: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
    """Returns the maps and K on a coarser grid, where all is known, and the grid's step.

    Pixel j of the coarser grid is pixel s j + o of the finer one. The centre of the latter,
    s j + o + 0.5, maps to j + 0.5: u' = (u - o - 0.5) / s + 0.5. Flow is in coarse pixels.
    """
    height, width = depth.shape[-2:]
    step = max(1, int((height * width / _SAMPLED_PIXELS) ** 0.5))
    offset = step // 2
    every = (..., slice(offset, None, step), slice(offset, None, step))
    raw, depth = raw[every].float() / step, depth[every].float()
    coarse = K.double().clone()
    coarse[:2, 2] -= offset + 0.5 - step / 2
    coarse[:2] /= step
    known = raw.isfinite().all(0, keepdim=True) & (depth > 0)
    if static is not None:
        known &= static[every]
    return raw, depth, coarse.float(), known, step


def _median_length(flow: Tensor, where: Tensor) -> float:
    lengths = flow.square().sum(0, keepdim=True).sqrt()[where]
    return float(lengths.nan_to_num(nan=torch.inf).median()) if lengths.numel() else float("nan")
