"""The pinhole camera: pixels and points, and K from what others give."""

import math

import pytest
import torch

from flowrep.geometry import intrinsics_from_fov, project, unproject
from tests.geometry.scenes import HEIGHT, WIDTH, K, assert_equals_a_loop, depth_map


def camera(fx=100.0, skew=0.0, cx=32.0, fy=50.0, cy=24.0) -> torch.Tensor:
    return torch.tensor([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(("skew", "u"), [(0.0, 57.0), (8.0, 61.0)])
def test_project_skew_by_hand(skew, u):
    # u = 100 * 1/4 + skew * 2/4 + 32, v = 50 * 2/4 + 24. With fx and fy swapped: (44.5, 74); were
    # skew applied to v: (57, 53).
    assert project(torch.tensor([1.0, 2.0, 4.0]), camera(skew=skew)).tolist() == [u, 49.0]


def test_pixel_to_camera_to_pixel_comes_back():
    pixels = project(unproject(depth_map(), K), K)
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    torch.testing.assert_close(pixels, torch.stack([u, v], -1).double(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("z", [0.0, -4.0, float("nan")])
def test_a_point_that_is_not_in_front_has_no_pixel(z):
    # Divided blindly, (1, 2, -4) would land at (7, -1), mirrored through the centre.
    assert project(torch.tensor([1.0, 2.0, z]), camera()).isnan().all()


def test_a_point_behind_gives_no_nan_to_the_gradient_of_the_others():
    points = torch.tensor([[1.0, 2.0, 4.0], [1.0, 2.0, 0.0]], requires_grad=True)
    project(points, camera())[0].sum().backward()
    # du/dx = fx / z = 25, dv/dy = fy / z = 12.5, d/dz = -(100 * 1 + 50 * 2) / 16.
    assert points.grad.tolist() == [[25.0, 12.5, -12.5], [0.0, 0.0, 0.0]]


def test_unproject_keeps_missing_and_infinite_depth_apart():
    points = unproject(torch.tensor([[[float("nan"), float("inf"), 2.0]]]), camera())
    assert points[0, 0].isnan().all()
    assert points[0, 1, 2] == float("inf")
    assert points[0, 2, 2] == 2.0


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_any_batch_equals_a_loop(batch):
    generator = torch.Generator().manual_seed(1)
    Ks = K + torch.rand((*batch, 3, 3), generator=generator, dtype=torch.float64)
    depth = depth_map(*batch)
    (points,) = assert_equals_a_loop(lambda *maps: (unproject(*maps),), batch, depth, Ks)
    assert points.shape == (*batch, HEIGHT, WIDTH, 3)
    assert_equals_a_loop(lambda *maps: (project(*maps),), batch, points, Ks)
    assert torch.equal(unproject(depth, K), unproject(depth, K.expand(*batch, 3, 3)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
def test_dtype_is_kept(dtype):
    points = unproject(torch.full((1, 1, 2), 2.0, dtype=dtype), camera().to(dtype))
    assert points.dtype == project(points, camera().to(dtype)).dtype == dtype


def test_gradients():
    depth = depth_map().requires_grad_()
    camera_matrix = K.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda d, k: project(unproject(d, k) + 0.3, k), (depth, camera_matrix)
    )


def test_field_of_view_across_the_width_or_the_height():
    # tan(45 deg) = 1: half of the picture, 3 or 2 px, lies as far out as the focal length.
    across_width = intrinsics_from_fov(90.0, axis="horizontal", height=4, width=6)
    across_height = intrinsics_from_fov(90.0, axis="vertical", height=4, width=6)
    assert across_width.tolist() == [[3.0, 0.0, 3.0], [0.0, 3.0, 2.0], [0.0, 0.0, 1.0]]
    assert across_height.tolist() == [[2.0, 0.0, 3.0], [0.0, 2.0, 2.0], [0.0, 0.0, 1.0]]
    # What lies on the field's rim is seen at the picture's: 30 degrees to the right of the axis.
    rim = torch.tensor([math.tan(math.radians(30.0)), 0.0, 1.0])
    K_60 = intrinsics_from_fov(60.0, axis="horizontal", height=4, width=6)
    torch.testing.assert_close(project(rim, K_60), torch.tensor([6.0, 2.0]))


def test_pixels_that_are_not_square():
    wide = intrinsics_from_fov(90.0, axis="horizontal", height=240, width=320, pixel_aspect=1.2)
    assert [wide[0, 0].item(), wide[1, 1].item()] == pytest.approx([160.0, 192.0])
    tall = intrinsics_from_fov(90.0, axis="vertical", height=240, width=320, pixel_aspect=1.2)
    assert [tall[0, 0].item(), tall[1, 1].item()] == pytest.approx([100.0, 120.0])
