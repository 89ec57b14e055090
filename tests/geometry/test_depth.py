"""Depth of other kinds, worked by hand."""

import math
from itertools import product

import numpy as np
import pytest
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
    # rounding beyond a plane is no hole: a step of float32 before the near one, either way round
    before = adapt_depth(depth_of(-6e-8), "z_buffer", near_m=0.5, far_m=8.0)
    reverse = adapt_depth(depth_of(1.0000001), "reversed_z_buffer", near_m=0.5, far_m=8.0)
    torch.testing.assert_close([before.item(), reverse.item()], [0.5, 0.5])
    # Without a far plane b = 1 - near / z: 0.75 at four times the near plane.
    endless = adapt_depth(depth_of(0.75), "z_buffer", near_m=0.5, far_m=math.inf)
    assert endless.item() == 2.0


def test_a_reversed_z_buffer_becomes_metres_and_keeps_what_is_far():
    # 1 at the near plane: b = (1/z - 1/far) / (1/near - 1/far). near 0.5 m, far 8 m, z = 2 m:
    # (0.5 - 0.125) / (2 - 0.125) = 0.2. Read as an ordinary one it would be 0.615 m.
    buffer = depth_of(1.0, 0.2, 0.0, 1.1, -0.1, math.nan)
    z = adapt_depth(buffer, "reversed_z_buffer", near_m=0.5, far_m=8.0).flatten()
    torch.testing.assert_close(z[:2], torch.tensor([0.5, 2.0]))
    assert z[2] == math.inf
    assert z[3:].isnan().all()
    # 999 m before a far plane of 1,000 m: 1 - b, in float32 the sky's 1, would lose the surface
    near, far, surface = 0.01, 1000.0, 999.0
    b = (1 / surface - 1 / far) / (1 / near - 1 / far)
    z = adapt_depth(depth_of(b), "reversed_z_buffer", near_m=near, far_m=far)
    torch.testing.assert_close(z.item(), surface, rtol=1e-5, atol=0)


@pytest.mark.parametrize("as_float64", [False, True])  # without numpy PyBullet returns a tuple
def test_the_sky_of_pybullets_software_renderer_is_no_wall(as_float64):
    # Where nothing is drawn it writes what is near 1: 0.9999999 at (0.1, 100), which is 99.99 m,
    # 1.0000001, out of [0, 1], at (0.02, 20). Here a wall at 0.9 of the far plane fills the lower
    # half of each picture.
    bullet = pytest.importorskip("pybullet")
    client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
    nears = [0.01, 0.02, 0.05, 0.1, 0.2]
    fars = [2, 3, 4, 5, 6, 7, 8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 70, 80, 100, 150, 200, 300]
    inexact, view = 0, bullet.computeViewMatrix([0, 0, 0], [1, 0, 0], [0, 0, 1])
    for near, far in product(nears, [*fars, 500, 700, 1000]):
        half = {"halfExtents": [0.01 * far, far, far]}
        shape = bullet.createVisualShape(bullet.GEOM_BOX, **half, **client)
        wall = bullet.createMultiBody(0, -1, shape, [0.91 * far, 0, -1.05 * far], **client)
        lens = bullet.computeProjectionMatrixFOV(60, 8 / 6, near, far)
        software = {"renderer": bullet.ER_TINY_RENDERER, **client}
        *_, buffer, ids = bullet.getCameraImage(8, 6, view, lens, **software)
        bullet.removeBody(wall, **client)
        buffer, ids = (np.reshape(part, (1, 6, 8)) for part in (buffer, ids))
        buffer = torch.as_tensor(buffer.astype("f8" if as_float64 else "f4"))
        is_wall = torch.as_tensor(ids) == wall
        assert is_wall.float().mean() == 0.5
        inexact += bool((buffer[~is_wall] != 1.0).any())
        z = adapt_depth(buffer, "z_buffer", near_m=near, far_m=far)
        assert (z[~is_wall] == math.inf).all(), (near, far)
        # a buffer's last digit is far / near times its spacing, 6e-8, in depth
        within = 1e-6 * far / near + 1e-3
        assert (z[is_wall] / (0.9 * far) - 1).abs().max() < within, (near, far)
    bullet.disconnect(**client)
    assert inexact > 10


def test_a_surface_that_the_buffer_tells_from_the_far_plane_is_none_of_the_sky():
    near, far = 0.1, 100.0
    below_one = depth_of(*(1 - k * 2.0**-24 for k in range(8)))
    z = adapt_depth(below_one, "z_buffer", near_m=near, far_m=far).flatten()
    assert z.isinf().tolist() == [True] * 4 + [False] * 4
    expected = near / (4 * 2.0**-24 * (1 - near / far) + near / far)  # 99.98 m
    torch.testing.assert_close(z[4].item(), expected, rtol=1e-6, atol=0)


def test_a_simulators_value_for_no_surface_becomes_inf():
    missed = adapt_depth(depth_of(0.0, -1.0, 0.5), "z", sky=0.0).flatten()
    assert missed.tolist() == [math.inf, math.inf, 0.5]
    far = adapt_depth(depth_of(20.0, 19.99, 25.0, 19.97), "z", sky=20.0).flatten()
    assert far.isinf().tolist() == [True, True, True, False]  # 0.999 of 20 is 19.98
    codes = torch.tensor([0, 2500, -32000], dtype=torch.int16).reshape(1, 1, 3)  # wrapped round
    z = adapt_depth(codes, "z", scale_m=1e-3, sky=0.0).flatten()
    assert z.tolist() == [math.inf, 2.5, math.inf]
    both = adapt_depth(depth_of(0.0, 9.0, math.nan, 1.0), "z", nothing=0.0, sky=9.0).flatten()
    assert both.isnan().tolist() == [True, False, True, False]
    assert both[1] == math.inf
    rays = adapt_depth(depth_of(1e10, 2.0, 2.0), "ray_length", K=CAMERA, sky=1e10).flatten()
    assert rays.isinf().tolist() == [True, False, False]
    with pytest.raises(ValueError, match=r"sky=0.*reversed_z_buffer"):
        adapt_depth(depth_of(0.0), "reversed_z_buffer", near_m=0.1, far_m=9.0, sky=0.0)
