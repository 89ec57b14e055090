"""Pinhole camera: projection of points in the camera's frame to pixels, and back."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from flowrep.geometry.checks import broadcast_batch, check_shape


def project(points_cam: Tensor, K: Tensor) -> Tensor:
    """Returns the pixel coordinates (u, v) at which a camera sees points.

    Convention: OpenCV camera (x right, y down, z forward), metres; u right, v down, pixels, the
    centre of pixel (0, 0) at (0.5, 0.5). A point that is not in front of the camera (z <= 0) has
    no image: its coordinates are nan.

    Equation 9 of the paper, with separate focal lengths and skew.

    Args:
        points_cam: `[*B, ..., 3]`, metres, in the camera's frame.
        K: `[*B, 3, 3]`; its batch dims are the leading dims of `points_cam`.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is not a float tensor.

    >>> K = torch.tensor([[100.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
    >>> project(torch.tensor([1.0, 2.0, 4.0]), K)
    tensor([57., 49.])
    """
    check_shape("points_cam", points_cam, (3,))
    check_shape("K", K, (3, 3))
    point_dims = points_cam.ndim - 1 - (K.ndim - 2)
    if point_dims < 0:
        raise ValueError(
            f"K has batch {list(K.shape[:-2])}, which points_cam {list(points_cam.shape)} lacks; "
            "K's batch dims are the leading dims of points_cam"
        )
    broadcast_batch(K=K.shape[:-2], points_cam=points_cam.shape[: K.ndim - 2])
    K = K.reshape(*K.shape[:-2], *[1] * point_dims, 3, 3)
    x, y, z = points_cam.unbind(-1)
    in_front = z > 0
    z = torch.where(in_front, z, 1.0)
    x, y = x / z, y / z
    u = K[..., 0, 0] * x + K[..., 0, 1] * y + K[..., 0, 2]
    v = K[..., 1, 1] * y + K[..., 1, 2]
    pixels = torch.stack(torch.broadcast_tensors(u, v), -1)
    return torch.where(in_front.unsqueeze(-1), pixels, math.nan)


def unproject(depth: Tensor, K: Tensor) -> Tensor:
    """Returns the point that each pixel shows, in the camera's frame, `[*B, H, W, 3]`.

    Convention: OpenCV camera (x right, y down, z forward), metres; depth is z along the optical
    axis (not the ray's length); pixel (column i, row j) is seen through its centre
    (i + 0.5, j + 0.5). Where depth is inf or nan the point is not finite.

    Equation 10 of the paper, with separate focal lengths and skew.

    Args:
        depth: `[*B, 1, H, W]`, metres.
        K: `[*B, 3, 3]`, batch broadcastable with depth's.

    Raises:
        ValueError: a shape does not fit.
        TypeError: an argument is not a float tensor.

    >>> K = torch.tensor([[2.0, 0.0, 1.0], [0.0, 4.0, 0.5], [0.0, 0.0, 1.0]])
    >>> unproject(torch.tensor([[[8.0, 8.0]]]), K)
    tensor([[[-2., 0., 8.], [ 2., 0., 8.]]])
    """
    check_shape("depth", depth, (1, "H", "W"))
    check_shape("K", K, (3, 3))
    broadcast_batch(depth=depth.shape[:-3], K=K.shape[:-2])
    dtype = torch.promote_types(depth.dtype, K.dtype)
    z = depth.squeeze(-3).to(dtype)
    x_px, y_px = centred_pixels(z.shape[-2], z.shape[-1], K.to(dtype))
    K = K.to(dtype)[..., None, None, :, :]
    y = y_px / K[..., 1, 1]
    x = (x_px - K[..., 0, 1] * y) / K[..., 0, 0]
    return torch.stack(torch.broadcast_tensors(x * z, y * z, z), -1)


def centred_pixels(height: int, width: int, K: Tensor) -> tuple[Tensor, Tensor]:
    """Returns pixel centres relative to the principal point: x `[*B, 1, W]`, y `[*B, H, 1]`."""
    cx, cy = K[..., 0, 2, None, None], K[..., 1, 2, None, None]
    u = torch.arange(width, dtype=K.dtype, device=K.device) + 0.5
    v = torch.arange(height, dtype=K.dtype, device=K.device) + 0.5
    return u - cx, v.unsqueeze(-1) - cy
