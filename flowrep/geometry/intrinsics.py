"""The intrinsics K from a simulator's field of view or from a calibration, and their check."""

from __future__ import annotations

import math
from typing import Literal, TypeAlias

import torch
from torch import Tensor

from flowrep.geometry.checks import check_name, check_shape

FovAxis: TypeAlias = Literal["horizontal", "vertical"]


def intrinsics_from_fov(
    fov_deg: float,
    *,
    axis: FovAxis,
    height: int,
    width: int,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Returns K `[3, 3]` of a camera with square pixels and a centred principal point.

    Convention: `axis` is the side of the picture that `fov_deg` spans from border to border:
    `"horizontal"` its width (Habitat's hfov), `"vertical"` its height (MuJoCo's fovy, OpenGL's
    perspective).

    Args:
        fov_deg: the whole angle, degrees, between 0 and 180.
        axis: `"horizontal"` or `"vertical"`.
        height: of the picture, pixels.
        width: of the picture, pixels.
        dtype: of the result.

    Raises:
        ValueError: an unknown axis, or an angle or a size out of range.

    >>> intrinsics_from_fov(90.0, axis="vertical", height=4, width=6)
    tensor([[2., 0., 3.],
            [0., 2., 2.],
            [0., 0., 1.]])
    """
    check_name("axis", axis, FovAxis)
    if not 0 < fov_deg < 180:
        raise ValueError(f"fov_deg must lie between 0 and 180 degrees, got {fov_deg}")
    if height < 1 or width < 1:
        raise ValueError(f"height and width must be at least 1 pixel, got {height} and {width}")
    half_size = (width if axis == "horizontal" else height) / 2
    focal = half_size / math.tan(math.radians(fov_deg) / 2)
    rows = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=torch.float64).to(dtype)


def intrinsics_from_opencv(K_opencv: Tensor) -> Tensor:
    """Returns K with pixel (0, 0)'s centre at (0.5, 0.5), given one with it at (0, 0).

    Args:
        K_opencv: `[*B, 3, 3]`, in the convention of OpenCV's calibration and most data sets.

    Raises:
        ValueError: not `[*B, 3, 3]`.
        TypeError: no float tensor.

    >>> intrinsics_from_opencv(torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 2.0], [0.0, 0.0, 1.0]]))
    tensor([[4.0000, 0.0000, 1.5000],
            [0.0000, 8.0000, 2.5000],
            [0.0000, 0.0000, 1.0000]])
    """
    check_shape("K_opencv", K_opencv, (3, 3))
    half_pixel = torch.zeros(3, 3, dtype=K_opencv.dtype, device=K_opencv.device)
    half_pixel[:2, 2] = 0.5
    return K_opencv + half_pixel


def check_intrinsics(name: str, K: Tensor) -> None:
    """Checks that every K has the rows (fx, skew, cx), (0, fy, cy), (0, 0, 1).

    The check waits for a GPU.

    Args:
        name: the argument's name, for the message.
        K: `[*B, 3, 3]`, pixels.

    Raises:
        ValueError: for nan or inf, other rows, or a focal length that is not positive; names the
            index of the first such K in the batch.
        TypeError: if it is not a float tensor.

    >>> check_intrinsics("K", torch.tensor([[4.0, 0.0, 0.0], [0.0, 8.0, 0.0], [1.5, 2.5, 1.0]]))
    Traceback (most recent call last):
    ValueError: K should have the rows (fx, skew, cx), (0, fy, cy), (0, 0, 1) in pixels, ...
    """
    check_shape(name, K, (3, 3))
    fixed = K.new_tensor([0.0, 0.0, 0.0, 1.0])
    zeros_and_one = torch.cat([K[..., 1, :1], K[..., 2, :]], -1)
    right = (
        K.isfinite().flatten(-2).all(-1)
        & (K.diagonal(dim1=-2, dim2=-1)[..., :2] > 0.0).all(-1)
        & ((zeros_and_one - fixed).abs() <= 1e-6).all(-1)
    )
    if not bool(right.all()):
        index = (~right).nonzero()[0].tolist()
        where = f"{name}[{', '.join(map(str, index))}]" if index else name
        raise ValueError(
            f"{where} should have the rows (fx, skew, cx), (0, fy, cy), (0, 0, 1) in pixels, "
            f"finite, fx and fy positive; got {K[tuple(index)].tolist()}. Pass K.T if it is "
            "transposed"
        )
