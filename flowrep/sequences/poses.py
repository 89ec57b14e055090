"""Camera poses of recordings: tables and timestamps."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from flowrep.geometry import CameraAxes, PoseDirection, PoseLayout, adapt_pose
from flowrep.sequences.files import read_table
from flowrep.sequences.frame import SequenceError

Pose = NDArray[np.float64]  # world_from_cam [4, 4]


def as_pose(
    numbers: NDArray[np.float64],
    source: Path,
    *,
    layout: PoseLayout = "matrix",
    direction: PoseDirection = "camera_to_world",
    axes: CameraAxes = "opencv",
) -> Pose:
    """Returns `world_from_cam` from the 7, 12 or 16 numbers of one pose.

    Raises:
        SequenceError: the pose has nan, an invalid quaternion, or a matrix that is not rigid.
    """
    values = torch.from_numpy(np.array(numbers, dtype=np.float64).reshape(-1))
    if layout == "matrix":
        last_row = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
        values = (torch.cat([values, last_row]) if len(values) == 12 else values).reshape(4, 4)
    try:
        pose = adapt_pose(values, layout=layout, direction=direction, axes=axes)
    except ValueError as error:
        raise SequenceError(source, str(error)) from None
    return pose.numpy()


def read_pose_lines(path: Path, layout: PoseLayout, frames: int) -> NDArray[np.float64]:
    """Returns the numbers of one pose per line, for a known number of frames.

    Raises:
        SequenceError: there are too few or too many lines, or numbers in a line.
    """
    table = read_table(path, [12, 16] if layout == "matrix" else [7])
    if len(table) != frames:
        raise SequenceError(path, f"has {len(table)} poses for {frames} frames")
    return table


def check_ascending(path: Path, times_s: NDArray[np.float64]) -> None:
    """Raises SequenceError if a time is not a number, or earlier than the one before it."""
    if not np.isfinite(times_s).all():
        raise SequenceError(path, "holds a timestamp that is not a number")
    backwards = np.flatnonzero(np.diff(times_s) < 0)
    if len(backwards):
        before, after = times_s[backwards[0]], times_s[backwards[0] + 1]
        raise SequenceError(path, f"timestamps go backwards: {after:.6f} follows {before:.6f}")


def nearest(
    times_s: NDArray[np.float64], wanted_s: NDArray[np.float64], tolerance_s: float
) -> NDArray[np.int64]:
    """Returns the index of the time nearest to each wanted one, -1 if none is near enough.

    >>> nearest(np.array([0.0, 1.0, 2.0]), np.array([0.98, 1.5, 2.03]), 0.05).tolist()
    [1, -1, 2]
    """
    after = np.searchsorted(times_s, wanted_s).clip(0, len(times_s) - 1)
    before = (after - 1).clip(0)
    gap_after, gap_before = (np.abs(times_s[index] - wanted_s) for index in (after, before))
    found = np.where(gap_before <= gap_after, before, after)
    return np.where(np.minimum(gap_before, gap_after) <= tolerance_s, found, -1)


def interpolated_pose(before: Pose, after: Pose, share: float) -> Pose:
    """Returns the pose at a share of the way, with constant velocity and angular velocity.

    >>> before, after = np.eye(4), np.eye(4)
    >>> after[0, 3] = 2.0
    >>> interpolated_pose(before, after, 0.25)[0, 3].item()
    0.5
    """
    relative = before[:3, :3].T @ after[:3, :3]
    axis_angle, _ = cv2.Rodrigues(relative)
    pose = np.eye(4)
    pose[:3, :3] = before[:3, :3] @ cv2.Rodrigues(share * axis_angle)[0]
    pose[:3, 3] = (1 - share) * before[:3, 3] + share * after[:3, 3]
    return pose
