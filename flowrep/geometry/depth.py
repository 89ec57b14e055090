"""Conversion of depth from simulators and cameras to depth along the optical axis.

What flow makes of depth that is unknown or infinite is said at `flowrep.geometry.ego_flow`.
"""

from __future__ import annotations

import math
from typing import Literal, TypeAlias

import torch
from torch import Tensor

from flowrep.geometry.camera import pixel_rays
from flowrep.geometry.checks import check_name, check_shape, common_batch

DepthKind: TypeAlias = Literal["z", "ray_length", "disparity", "z_buffer", "reversed_z_buffer"]

# Which of the arguments that are needed by some kinds alone.
_READ_BY: dict[str, list[str]] = {
    "z": [], "ray_length": ["K"], "disparity": ["K", "baseline_m"],
    "z_buffer": ["near_m", "far_m"], "reversed_z_buffer": ["near_m", "far_m"],
}  # fmt: skip
# How far a depth buffer may be from 1 where nothing is drawn. The float32 products in PyBullet's
# software renderer are off by up to three times the spacing of numbers below 1.
_ROUNDING = 3 * 2.0**-24


def adapt_depth(
    depth: Tensor,
    kind: DepthKind,
    *,
    K: Tensor | None = None,
    near_m: float | None = None,
    far_m: float | None = None,
    scale_m: float | None = None,
    nothing: float | None = None,
    sky: float | None = None,
    baseline_m: float | None = None,
) -> Tensor:
    """Returns depth along the optical axis, `[*B, 1, H, W]`, metres.

    Convention: `"z"` is depth along the optical axis and returned unchanged. `"ray_length"` is the
    distance from the camera's centre to the surface, metres (lidar, "distance to camera").
    `"disparity"` is that of a rectified pair of cameras, in pixels of a picture of this size:
    z = fx · baseline / disparity, so that 0 is inf and a negative one nan.
    `"z_buffer"` is OpenGL's depth buffer in [0, 1], 0 at `near_m` and 1 at `far_m` or where nothing
    was drawn. `"reversed_z_buffer"` is 1 at `near_m` and 0 at `far_m` or where nothing was drawn
    (MuJoCo's `mjDEPTH_ZEROFAR`, many game engines). Where nothing was drawn the result is inf; inf
    stays inf and nan stays nan.

    Args:
        depth: `[*B, 1, H, W]`, of that `kind`.
        kind: `"z"`, `"ray_length"`, `"disparity"`, `"z_buffer"` or `"reversed_z_buffer"`.
        K: `[*B, 3, 3]`, pixels; only for `"ray_length"` and `"disparity"`.
        near_m: the near plane; only for the two buffers.
        far_m: the far plane, `math.inf` if the projection has none; only for the two buffers.
        scale_m: metres per unit of `depth`, 1 if it is float; whole numbers, such as uint16
            millimetres (0.001), need it. Of disparity, pixels per unit. Not for the two buffers.
        nothing: a value, before scaling, that means missing depth; it becomes nan.
        sky: a value, before scaling, that means no surface. A positive value is a far plane: depth
            from 0.999 of it on becomes inf. Otherwise, depth up to the value becomes inf. Not for
            the two buffers.
        baseline_m: the distance of the two cameras; only for `"disparity"`.

    Raises:
        ValueError: an argument that `kind` needs is missing, or one that it doesn't read is given.

    >>> adapt_depth(torch.tensor([[[0.0, 0.75, 1.0]]]), "z_buffer", near_m=1.0, far_m=3.0)
    tensor([[[1., 2., inf]]])
    >>> adapt_depth(torch.tensor([[[0, 2500]]]).short(), "z", scale_m=1e-3, nothing=0)
    tensor([[[   nan, 2.5000]]])
    >>> adapt_depth(torch.tensor([[[8.0, 0.0]]]), "disparity", K=40 * torch.eye(3), baseline_m=0.1)
    tensor([[[0.5000,    inf]]])
    """
    check_name("kind", kind, DepthKind)
    given = {"K": K, "baseline_m": baseline_m, "near_m": near_m, "far_m": far_m}
    named = [name for name, value in given.items() if value is not None]
    if named != _READ_BY[kind]:
        raise ValueError(
            f"depth of kind {kind!r} needs {_READ_BY[kind] or 'none'} of {[*given]}, got {named}; "
            "K is AdaptDepth's intrinsics"
        )
    if baseline_m is not None and not baseline_m > 0:
        raise ValueError(f"baseline_m must be a positive number of metres, got {baseline_m}")
    is_buffer = kind.endswith("z_buffer")
    if scale_m is not None and (is_buffer or not 0 < scale_m < math.inf):
        raise ValueError(
            f"scale_m is metres per unit, positive, and a z-buffer has none; kind is {kind!r}, "
            f"scale_m={scale_m}"
        )
    if sky is not None and is_buffer:
        raise ValueError(f"a z-buffer's sky is its far plane, not sky={sky}; kind is {kind!r}")
    is_sky = None if sky is None else _is_sky(depth, sky)
    unmeasured = None if nothing is None else depth == nothing
    if scale_m is not None:
        # Divided, because 1 / 0.001 is exact and 0.001 isn't: 3,000 mm become 3 m, not 3.0000002.
        depth = (depth if depth.is_floating_point() else depth.float()) / (1.0 / scale_m)
    if unmeasured is not None:
        depth = torch.where(unmeasured, torch.nan, depth)
    if is_sky is not None:
        depth = torch.where(is_sky, torch.inf, depth)
    check_shape("depth", depth, (1, "H", "W"))
    if K is not None and baseline_m is not None:
        check_shape("K", K, (3, 3))
        common_batch(depth=depth.shape[:-3], K=K.shape[:-2])
        focal_px = K[..., 0, 0].to(depth.dtype)[..., None, None, None]
        return torch.where(depth < 0, torch.nan, focal_px * baseline_m / depth.abs())
    if K is not None:
        return z_from_ray_length(depth, K)
    if near_m is not None and far_m is not None:
        is_reversed = kind == "reversed_z_buffer"
        return z_from_z_buffer(depth, near_m=near_m, far_m=far_m, is_reversed=is_reversed)
    return depth


def _is_sky(depth: Tensor, sky: float) -> Tensor:
    """Returns where depth is the simulator's value for no surface, or beyond it."""
    # Depth at the far plane, computed from a float32 buffer, is off by up to a thousandth.
    return depth >= 0.999 * sky if sky > 0 else depth <= sky


def z_from_ray_length(ray_length: Tensor, K: Tensor) -> Tensor:
    """Returns depth along the optical axis from ray lengths, `[*B, 1, H, W]`, metres.

    Convention: see `adapt_depth`.

    Args:
        ray_length: `[*B, 1, H, W]`, metres from the camera's centre.
        K: `[*B, 3, 3]`, pixels.

    >>> K = torch.tensor([[4.0, 0.0, -2.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]])
    >>> z_from_ray_length(torch.full((1, 1, 1), 5.0), K)  # it looks along (0.75, 0, 1)
    tensor([[[4.]]])
    """
    check_shape("ray_length", ray_length, (1, "H", "W"))
    check_shape("K", K, (3, 3))
    common_batch(ray_length=ray_length.shape[:-3], K=K.shape[:-2])
    K = K.to(torch.promote_types(ray_length.dtype, torch.float32))
    x, y = pixel_rays(ray_length.shape[-2], ray_length.shape[-1], K)
    per_z = (1.0 + x.square() + y.square()).sqrt()  # length of the ray per metre of z
    return (ray_length / per_z.unsqueeze(-3)).to(ray_length.dtype)


def z_from_z_buffer(
    z_buffer: Tensor, *, near_m: float, far_m: float, is_reversed: bool = False
) -> Tensor:
    """Returns depth along the optical axis from a perspective camera's depth buffer, metres.

    Convention: see `adapt_depth`. The result is inf where nothing was drawn and nan where the
    buffer is outside [0, 1], both up to rounding: PyBullet's software renderer has 0.9999999 or
    1.0000001 where nothing was drawn, so a surface that close to the far plane counts as none. A
    reversed buffer is exactly 0 there, since numbers near 0 are exact.

    Args:
        z_buffer: `[*B, 1, H, W]`, 0 to 1.
        near_m: the near plane, more than 0.
        far_m: the far plane, farther than `near_m`; may be inf.
        is_reversed: whether 1 is at the near plane.

    >>> z_from_z_buffer(torch.tensor([[[0.5]]]), near_m=0.5, far_m=torch.inf)
    tensor([[[1.]]])
    """
    check_shape("z_buffer", z_buffer, (1, "H", "W"))
    if not 0 < near_m < far_m:
        raise ValueError(f"planes need 0 < near_m < far_m, got near_m={near_m}, far_m={far_m}")
    tolerance = _ROUNDING / (1.0 - near_m / far_m)
    if is_reversed:
        to_near, to_far, is_sky = z_buffer, 1.0 - z_buffer, z_buffer == 0.0
    else:
        to_near, to_far, is_sky = 1.0 - z_buffer, z_buffer, (1.0 - z_buffer).abs() <= tolerance
    # near * far / (far - b (far - near)), without a difference of large numbers near the far plane
    z = torch.where(is_sky, torch.inf, near_m / (to_near + to_far * (near_m / far_m)))
    is_known = is_sky | ((to_near >= 0.0) & (to_far >= -tolerance))
    return torch.where(is_known, z, torch.nan)
