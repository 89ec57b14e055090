"""The pinhole camera: projection, its inverse, and the intrinsics K from other conventions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, TypeAlias

import torch
from torch import Tensor

from flowrep.geometry.checks import (
    check_name,
    check_shape,
    checked_count,
    common_batch,
    first_wrong,
    over_points,
)

FovAxis: TypeAlias = Literal["horizontal", "vertical"]

# What `check_intrinsics` takes for possible.
MIN_FOCAL, MAX_FOCAL = 0.2, 20.0  # focal lengths, in lengths of the picture's longer side
MIN_BORDER = 0.1  # of the principal point to the border, as a share of the width or the height


def project(points_cam: Tensor, K: Tensor) -> Tensor:
    """Returns the pixel coordinates (u, v) at which a camera sees points, `[*B, ..., 2]`.

    Convention: OpenCV camera (x right, y down, z forward), metres; u right, v down, pixels, the
    centre of pixel (0, 0) at (0.5, 0.5). A point that is not in front of the camera (z <= 0) has
    no image: its coordinates are nan.

    Equation 9 of the paper, with separate focal lengths and skew.

    Args:
        points_cam: `[*B, ..., 3]`, metres, in camera coordinates.
        K: `[*B, 3, 3]`; its batch dims are the leading dims of `points_cam`.

    >>> K = torch.tensor([[100.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
    >>> project(torch.tensor([1.0, 2.0, 4.0]), K)
    tensor([57., 49.])
    """
    check_shape("points_cam", points_cam, (3,))
    check_shape("K", K, (3, 3))
    K = over_points("K", K, "points_cam", points_cam)
    x, y, z = points_cam.unbind(-1)
    in_front = z > 0
    z = torch.where(in_front, z, 1.0)  # no division by 0, whose gradient would be nan
    x, y = x / z, y / z
    u = K[..., 0, 0] * x + K[..., 0, 1] * y + K[..., 0, 2]
    v = K[..., 1, 1] * y + K[..., 1, 2]
    pixels = torch.stack(torch.broadcast_tensors(u, v), -1)
    return torch.where(in_front.unsqueeze(-1), pixels, math.nan)


def unproject(depth: Tensor, K: Tensor) -> Tensor:
    """Returns the point that each pixel shows, in camera coordinates, `[*B, H, W, 3]`.

    Convention: as in `project`. Depth is z along the optical axis (not the ray's length), and the
    pixel in column i, row j is seen through its centre (i + 0.5, j + 0.5). Where depth is inf or
    nan the point is not finite.

    Equation 10 of the paper, with separate focal lengths and skew.

    Args:
        depth: `[*B, 1, H, W]`, metres.
        K: `[*B, 3, 3]`, batch broadcastable with depth's.

    >>> K = torch.tensor([[2.0, 0.0, 1.0], [0.0, 4.0, 0.5], [0.0, 0.0, 1.0]])
    >>> unproject(torch.tensor([[[8.0, 8.0]]]), K)
    tensor([[[-2., 0., 8.], [ 2., 0., 8.]]])
    """
    check_shape("depth", depth, (1, "H", "W"))
    check_shape("K", K, (3, 3))
    common_batch(depth=depth.shape[:-3], K=K.shape[:-2])
    dtype = torch.promote_types(depth.dtype, K.dtype)
    z = depth.squeeze(-3).to(dtype)
    x, y = pixel_rays(z.shape[-2], z.shape[-1], K.to(dtype))
    return torch.stack(torch.broadcast_tensors(x * z, y * z, z), -1)


def centred_pixels(height: int, width: int, K: Tensor) -> tuple[Tensor, Tensor]:
    """Returns pixel centres relative to the principal point: x `[*B, 1, W]`, y `[*B, H, 1]`."""
    cx, cy = K[..., :2, 2:].split(1, -2)
    u = torch.arange(width, dtype=K.dtype, device=K.device) + 0.5
    v = torch.arange(height, dtype=K.dtype, device=K.device) + 0.5
    return u - cx, v.unsqueeze(-1) - cy


def pixel_rays(height: int, width: int, K: Tensor) -> tuple[Tensor, Tensor]:
    """Returns x / z `[*B, H, W]` and y / z `[*B, H, 1]` of the ray through each pixel's centre."""
    x_px, y_px = centred_pixels(height, width, K)
    K = K[..., None, None, :, :]
    y = y_px / K[..., 1, 1]
    return (x_px - K[..., 0, 1] * y) / K[..., 0, 0], y


def intrinsics_from_fov(
    fov_deg: float, *, axis: FovAxis, height: int, width: int, pixel_aspect: float = 1.0
) -> Tensor:
    """Returns K `[3, 3]` of a camera with a centred principal point.

    Convention: the field of view spans the picture from border to border, along `axis`:
    `"horizontal"` across its width (Habitat's hfov), `"vertical"` across its height (MuJoCo's fovy,
    OpenGL's perspective).

    Args:
        fov_deg: the field of view, degrees, between 0 and 180.
        axis: `"horizontal"` or `"vertical"`.
        height: of the picture, pixels.
        width: of the picture, pixels.
        pixel_aspect: a pixel's width over its height, fy / fx; 1 for square pixels.

    >>> intrinsics_from_fov(90.0, axis="vertical", height=4, width=6)
    tensor([[2., 0., 3.],
            [0., 2., 2.],
            [0., 0., 1.]])
    """
    check_name("axis", axis, FovAxis)
    if not 0 < fov_deg < 180:
        raise ValueError(f"fov_deg must lie between 0 and 180 degrees, got {fov_deg}")
    for name, side in {"height": height, "width": width}.items():
        checked_count(name, side)
    if not 0 < pixel_aspect < math.inf:
        raise ValueError(f"pixel_aspect must be positive, got {pixel_aspect}")
    focal = (width if axis == "horizontal" else height) / 2 / math.tan(math.radians(fov_deg) / 2)
    fx, fy = focal, focal * pixel_aspect
    if axis == "vertical":
        fx, fy = focal / pixel_aspect, focal
    rows = [[fx, 0.0, width / 2], [0.0, fy, height / 2], [0.0, 0.0, 1.0]]
    return torch.tensor(rows, dtype=torch.float32)


def intrinsics_from_opencv(K_opencv: Tensor) -> Tensor:
    """Returns K `[*B, 3, 3]` with pixel (0, 0)'s centre at (0.5, 0.5): half a pixel more cx and cy.

    Convention: `K_opencv` `[*B, 3, 3]` has that centre at (0, 0), as OpenCV's calibration and most
    data sets have it.

    >>> intrinsics_from_opencv(torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 2.0], [0.0, 0.0, 1.0]]))
    tensor([[4.0000, 0.0000, 1.5000],
            [0.0000, 8.0000, 2.5000],
            [0.0000, 0.0000, 1.0000]])
    """
    check_shape("K_opencv", K_opencv, (3, 3))
    half_pixel = torch.zeros(3, 3, dtype=K_opencv.dtype, device=K_opencv.device)
    half_pixel[:2, 2] = 0.5
    return K_opencv + half_pixel


def check_intrinsics(
    name: str, K: Tensor, size: tuple[int, int] | None = None, *, allow_unknown: bool = False
) -> None:
    """Checks that every K `[*B, 3, 3]` can be a camera's, with pictures of `size` (height, width).

    The bounds for a size are wide: a focal length of 0.2 to 20 times the longer side, that is,
    fields of view of 136 to 3 degrees, and a principal point at least a tenth of the picture inside
    its border. Real lenses are centred to a few per cent, and a crop may cut off four ninths of the
    picture on one side. The K of a picture of twice the size is refused, since its principal point
    is at the border.

    The check waits for a GPU.

    Args:
        name: of the argument, for the message.
        allow_unknown: whether a K with nan, inf or a focal length of 0 passes; the flow functions
            mark its frame invalid.

    Raises:
        ValueError: names the first K whose rows are not (fx, skew, cx), (0, fy, cy), (0, 0, 1),
            that has nan, inf or a focal length that is not positive, or that can't belong to a
            picture of that size.

    >>> check_intrinsics("K", torch.tensor([[4.0, 0.0, 0.0], [0.0, 8.0, 0.0], [1.5, 2.5, 1.0]]))
    Traceback (most recent call last):
    ValueError: K should have the rows (fx, skew, cx), (0, fy, cy), (0, 0, 1) in pixels, ...
    >>> check_intrinsics("K", torch.tensor([[60.0, 0, 80], [0, 60, 60], [0, 0, 1]]), (60, 80))
    Traceback (most recent call last):
    ValueError: K can't belong to a picture 80 px wide and 60 px high: ...
    """
    check_shape(name, K, (3, 3))
    fixed = K.new_tensor([0.0, 0.0, 0.0, 1.0])
    zeros_and_one = torch.cat([K[..., 1, :1], K[..., 2, :]], -1)
    focal = K.diagonal(dim1=-2, dim2=-1)[..., :2]
    known = K.isfinite().flatten(-2).all(-1)
    wrong = ~known | (focal <= 0.0).any(-1) | ((zeros_and_one - fixed).abs() > 1e-6).any(-1)
    unknown = ~known | (focal == 0.0).any(-1) if allow_unknown else torch.zeros_like(wrong)
    if bool((wrong & ~unknown).any()):
        where, index = first_wrong(name, wrong & ~unknown)
        raise ValueError(
            f"{where} should have the rows (fx, skew, cx), (0, fy, cy), (0, 0, 1) in pixels, "
            f"finite, fx and fy positive; got {K[index].tolist()}. Pass K.T if it is transposed"
        )
    if size is None or not min(size):
        return
    # As floats, because a float16 can't hold 20 times the side of a large picture.
    wrong = ~_fits(*K.float().flatten(-2).unbind(-1), size=size) & ~unknown
    if bool(wrong.any()):
        where, index = first_wrong(name, wrong)
        check_fit(where, K[index].tolist(), size)


def check_fit(name: str, K: Sequence[Sequence[float]], size: tuple[int, int]) -> None:
    """Checks that the rows of one K, as numbers, fit pictures of `size`; see `check_intrinsics`.

    Compiled code can do it, as it reads no tensor.
    """
    height, width = size
    side = max(size)
    if side == 0 or _fits(*K[0], *K[1], *K[2], size=size):
        return
    raise ValueError(
        f"{name} can't belong to a picture {width} px wide and {height} px high: fx and fy "
        f"should be {MIN_FOCAL * side:g} to {MAX_FOCAL * side:g} px, "
        f"cx {MIN_BORDER * width:g} to {(1 - MIN_BORDER) * width:g}, "
        f"cy {MIN_BORDER * height:g} to {(1 - MIN_BORDER) * height:g}; "
        f"got {K}. If it is for another picture size, or was divided by the size, scale its first "
        "two rows"
    )


def _fits(*K: Any, size: tuple[int, int]) -> Any:
    """Returns whether pictures can have that size, from K's nine numbers or tensors."""
    fx, _, cx, _, fy, cy, *_ = K
    (height, width), side = size, max(size)
    fits = (abs(cx / width - 0.5) <= 0.5 - MIN_BORDER) & (
        abs(cy / height - 0.5) <= 0.5 - MIN_BORDER
    )
    for focal in (fx, fy):
        fits = fits & (focal >= MIN_FOCAL * side) & (focal <= MAX_FOCAL * side)
    return fits
