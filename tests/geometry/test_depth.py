"""Depth of other kinds, worked by hand."""

from __future__ import annotations

import math

import torch

from flowrep.geometry import adapt_depth, unproject
from tests.geometry.scenes import K, depth_map

# 1 x 3 pixels whose rays lead through (-0.75, 0.5), (0, 0.5) and (0.75, 0.5) at z = 1.
CAMERA = torch.tensor([[4.0, 0.0, 3.5], [0.0, 8.0, -3.5], [0.0, 0.0, 1.0]])


def depth_of(*values: float) -> torch.Tensor:
    return torch.tensor(values).reshape(1, 1, -1)


def test_depth_that_is_z_stays():
    depth = depth_of(2.0, math.inf, math.nan)
    assert adapt_depth(depth, "z") is depth


def test_the_length_of_a_ray_becomes_its_z():
    # Columns 0, 3 and 6 look along x = -0.75, 0 and 0.75, y = 0.5: the ray that reaches z = 1 is
    # sqrt(1 + 0.5625 + 0.25) = 1.34629 and sqrt(1.25) = 1.11803 long.
    length = depth_of(1.34629, 9.0, 9.0, 2.23607, math.inf, math.nan, 2.69258)
    z = adapt_depth(length, "ray_length", K=CAMERA).flatten()
    torch.testing.assert_close(z[[0, 3, 6]], torch.tensor([1.0, 2.0, 2.0]), atol=1e-5, rtol=0)
    assert z[4] == math.inf
    assert z[5].isnan()


def test_ray_length_comes_back_from_points_with_skew_and_batch():
    depth = depth_map(2, 3)
    length = unproject(depth, K).norm(dim=-1).unsqueeze(-3)
    torch.testing.assert_close(adapt_depth(length, "ray_length", K=K), depth)


def test_an_opengl_z_buffer_becomes_metres():
    # OpenGL writes b = (1/z - 1/near) / (1/far - 1/near). near 0.5 m, far 8 m, z = 2 m:
    # (0.5 - 2) / (0.125 - 2) = 0.8. Read as linear between the planes it would be 6.5 m.
    buffer = depth_of(0.0, 0.8, 1.0, -0.1, 1.1, math.nan)
    z = adapt_depth(buffer, "z_buffer", near_m=0.5, far_m=8.0).flatten()
    torch.testing.assert_close(z[:2], torch.tensor([0.5, 2.0]))
    assert z[2] == math.inf  # nothing was drawn
    assert z[3:].isnan().all()
    # Without a far plane b = 1 - near / z: 0.75 at four times the near plane.
    endless = adapt_depth(depth_of(0.75), "z_buffer", near_m=0.5, far_m=math.inf)
    assert endless.item() == 2.0
