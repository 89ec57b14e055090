"""Cameras of recordings: intrinsics, poses, registration of depth to colour."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pydantic
import torch
from numpy.typing import NDArray

from flowrep.geometry import CameraAxes, PoseDirection, PoseLayout, adapt_pose
from flowrep.sequences.files import read_table
from flowrep.sequences.recording import Pose, SequenceError

Matrix = NDArray[np.float64]


class Camera(pydantic.BaseModel):
    """A camera in `intrinsics.json`, see docs/factorize.md."""

    model_config = pydantic.ConfigDict(allow_inf_nan=False)

    width: pydantic.PositiveInt
    height: pydantic.PositiveInt
    fx: pydantic.PositiveFloat
    fy: float
    cx: float
    cy: float
    first_pixel_centre: Literal[0.0, 0.5]  # type: ignore[valid-type]

    @pydantic.field_validator("fy")
    @classmethod
    def _is_right_handed(cls, fy: float) -> float:
        if fy > 0:
            return fy
        raise ValueError(
            "should be positive. Where it is negative (ICL-NUIM) the camera is left-handed, with y "
            "up and z ahead: mirror the poses, F @ pose @ F with F = diag(1, -1, 1, 1)"
        )

    @property
    def K(self) -> Matrix:
        """In flowrep's convention."""
        shift = 0.5 - self.first_pixel_centre
        return intrinsics(self.fx, self.fy, self.cx + shift, self.cy + shift)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.height, self.width


Row = tuple[float, float, float, float]


class ColourCamera(Camera):
    """A second camera, to whose pixels depth is registered."""

    colour_from_depth: tuple[Row, Row, Row, Row]


class Cameras(Camera):
    """Depth's camera, and colour's if it is another."""

    colour: ColourCamera | None = None


def read_cameras(path: Path) -> Cameras:
    """Returns the content of an `intrinsics.json`."""
    remedy = (
        'it holds {"width": .., "height": .., "fx": .., "fy": .., "cx": .., "cy": .., '
        '"first_pixel_centre": 0 (as OpenCV calibrates) or 0.5}'
    )
    if not path.is_file():
        raise SequenceError(path, f"no such file; {remedy}")
    try:
        return Cameras.model_validate_json(path.read_bytes())
    except pydantic.ValidationError as error:
        lines = [f"{'.'.join(map(str, e['loc']))} {e['msg']}".strip() for e in error.errors()]
        raise SequenceError(path, f"{', '.join(lines)}; {remedy}") from None


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Matrix:
    """Returns K `[3, 3]`."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def opencv_intrinsics(numbers: Sequence[float]) -> Matrix:
    """Returns K from fx, fy, cx, cy of a calibration with the centre of pixel (0, 0) at (0, 0).

    >>> opencv_intrinsics([525.0, 525.0, 319.5, 239.5])[:2, 2]
    array([320., 240.])
    """
    fx, fy, cx, cy = numbers
    return intrinsics(fx, fy, cx + 0.5, cy + 0.5)


def check_numbers(option: str, numbers: Sequence[float], meaning: str) -> None:
    """Raises SequenceError if an option has not as many numbers as its meaning, "x, y, z"."""
    if len(numbers) != len(meaning.split(", ")):
        raise SequenceError(option, f"should be [{meaning}], not {list(numbers)}")


def as_pose(
    numbers: NDArray[np.float64],
    source: Path,
    *,
    layout: PoseLayout = "matrix",
    direction: PoseDirection = "camera_to_world",
    axes: CameraAxes = "opencv",
) -> Pose:
    """Returns `world_from_cam` `[*B, 4, 4]` from the 7, 12 or 16 numbers of each pose."""
    values = torch.from_numpy(np.array(numbers, dtype=np.float64))
    if layout == "matrix":
        values = values.unflatten(-1, (-1, 4))
        layout = "matrix" if values.shape[-2] == 4 else "matrix_3x4"
    try:
        return adapt_pose(values, layout=layout, direction=direction, axes=axes).numpy()
    except ValueError as error:
        raise SequenceError(source, str(error)) from None


def read_poses(path: Path, frames: int, *, layout: PoseLayout = "xyz_xyzw", **options: Any) -> Pose:
    """Returns `world_from_cam` `[N, 4, 4]` of a file with a pose per line, for `as_pose`."""
    numbers = read_table(path, 7, 12, 16)
    if len(numbers) != frames:
        raise SequenceError(path, f"has {len(numbers)} poses for {frames} frames")
    width = numbers.shape[1]
    fitting = ("xyz_xyzw", "xyz_wxyz") if width == 7 else ("matrix",)
    if layout not in fitting:
        remedy = " or ".join(f"format.pose_layout={name}" for name in fitting)
        raise SequenceError(path, f"has {width} numbers in a line, as {remedy}")
    return as_pose(numbers, path, layout=layout, **options)


_LARGEST_FOOTPRINT_PX = 8


class Registration:
    """Registers depth to the pixels of colour pictures of a size (height, width).

    Each depth pixel becomes a square that faces the camera, as large as the pixel is at its
    distance and at least one colour pixel; if several fall on one colour pixel, the nearest is
    visible. Colour pixels that no square reaches (hidden from the depth camera, or outside its
    picture) are missing, nan.

    >>> K = np.array([[4.0, 0.0, 1.0], [0.0, 4.0, 0.5], [0.0, 0.0, 1.0]])
    >>> colour_from_depth = np.eye(4)
    >>> colour_from_depth[0, 3] = 0.5  # at 2 m that is 4 * 0.5 / 2 = 1 px to the right
    >>> Registration(K, K, colour_from_depth, (1, 2))(np.array([[2.0, 8.0]], np.float32))
    array([[nan,  2.]], dtype=float32)
    """

    def __init__(
        self, K_depth: Matrix, K_colour: Matrix, colour_from_depth: Pose, size: tuple[int, int]
    ) -> None:
        self.size = size
        self.depth_from_colour = np.linalg.inv(colour_from_depth)
        # The largest focal length of the colour camera over the smallest of the depth camera.
        self._finer = np.float32(
            max(K_colour[0, 0], K_colour[1, 1]) / min(K_depth[0, 0], K_depth[1, 1])
        )
        # p_colour ~ z (to_colour @ pixel) + shift, so only one product per pixel is left to do.
        self._to_colour = K_colour @ colour_from_depth[:3, :3] @ np.linalg.inv(K_depth)
        self._shift = (K_colour @ colour_from_depth[:3, 3]).astype(np.float32)
        self._rays = np.empty((3, 0, 0), np.float32)  # to_colour @ pixel, of the last size seen

    def __call__(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the colour camera's depth, nan where missing; nan and inf are no surface."""
        if self._rays.shape[1:] != depth.shape:
            row, column = np.indices(depth.shape) + 0.5
            pixels = np.stack([column, row, np.ones(depth.shape)]).reshape(3, -1)
            self._rays = (self._to_colour @ pixels).reshape(3, *depth.shape).astype(np.float32)
        x, y, z = (ray * depth + shift for ray, shift in zip(self._rays, self._shift))
        surface = np.isfinite(depth) & (depth > 0) & (z > 0)
        u, v, z, z_depth = x[surface], y[surface], z[surface], depth[surface]
        u, v = u / z, v / z
        side = np.maximum((z_depth / z) * self._finer, 1.0)
        # The nearest square around (u, v) covers the pixels whose centres lie in
        # [u - side / 2, u + side / 2).
        height, width = self.size
        seen = np.full(height * width + 1, np.inf, dtype=np.float32)  # the last: outside
        first_u, first_v = (np.ceil(a - (side + 1) / 2).astype(np.int64) for a in (u, v))
        reach = min(math.ceil(side.max(initial=0.0)), _LARGEST_FOOTPRINT_PX)
        for right, down in np.ndindex(reach, reach):
            column, row = first_u + right, first_v + down
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            if right or down:
                inside &= (column + 0.5 < u + side / 2) & (row + 0.5 < v + side / 2)
            np.minimum.at(seen, np.where(inside, row * width + column, height * width), z)
        seen[np.isinf(seen)] = np.nan
        return seen[:-1].reshape(height, width)
