"""Float types: how near float32 stays to float64, and what the narrow types give."""

import math

import pytest
import torch

from flowrep.geometry import ego_flow, factorize, rigid_flow
from tests.geometry.scenes import flow_by_points, rigid

SIZE = 84


def street(yaw_deg: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns depth, K and motion of a camera at 10 m/s and 12 frames/s, float32."""
    generator = torch.Generator().manual_seed(8)
    depth = 2 + 60 * torch.rand((1, SIZE, SIZE), generator=generator)
    camera = torch.tensor([[42.0, 0.0, 42.0], [0.0, 42.0, 42.0], [0.0, 0.0, 1.0]])
    return depth, camera, rigid((0.0, math.radians(yaw_deg), 0.01), (0.02, 0.01, 0.83)).float()


def flow_by_homography(depth, camera, motion) -> torch.Tensor:
    """Returns p - p' by the homography K R K^-1 plus epipole over depth, uncentred."""
    homography = camera @ motion[:3, :3] @ torch.linalg.inv(camera)
    axis = torch.arange(SIZE, dtype=depth.dtype) + 0.5
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)], -1)
    previous = pixels @ homography.T + (camera @ motion[:3, 3]) / depth[0, ..., None]
    return (pixels[..., :2] - previous[..., :2] / previous[..., 2:]).permute(2, 0, 1)


@pytest.mark.parametrize("yaw_deg", [0.0, 1.0, 3.0, 6.0])
def test_float32_error_is_an_order_of_magnitude_below_the_homography_s(yaw_deg):
    inputs = street(yaw_deg)
    exact = flow_by_points(*(tensor.double() for tensor in inputs))
    error = (ego_flow(*inputs).flow - exact).abs().max()
    homography_error = (flow_by_homography(*inputs) - exact).abs().max()
    assert error < 4e-6  # px; flow itself reaches 16 px
    assert homography_error > 5 * error


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_narrow_types_are_computed_in_float32_and_rounded_once(dtype):
    inputs = [tensor.to(dtype) for tensor in street(2.0)]
    wide = [tensor.float() for tensor in inputs]
    assert torch.equal(ego_flow(*inputs).flow, ego_flow(*wide).flow.to(dtype))
    depth, camera, motion = inputs
    instance = (torch.arange(SIZE**2) % 2).reshape(1, SIZE, SIZE)
    motions = torch.stack([motion, rigid((0.0, 0.0, 0.1), (0.5, 0.0, 0.0)).to(dtype)])
    flow = rigid_flow(depth, instance, camera, motions).flow
    wide_flow = rigid_flow(depth.float(), instance, camera.float(), motions.float()).flow
    assert torch.equal(flow, wide_flow.to(dtype))


def test_result_has_the_widest_type():
    depth, camera, motion = street(1.0)
    instance = torch.zeros_like(depth, dtype=torch.int32)
    raw = torch.zeros(2, SIZE, SIZE)
    assert ego_flow(depth.half(), camera, motion.bfloat16()).flow.dtype == torch.float32
    assert ego_flow(depth, camera, motion.double()).flow.dtype == torch.float64
    assert rigid_flow(depth, instance, camera.double(), motion[None]).flow.dtype == torch.float64
    assert factorize(raw, depth, camera, motion.double()).obj.dtype == torch.float64
    narrow = factorize(raw.half(), depth.half(), camera.half(), motion.half())
    assert narrow.ego.dtype == narrow.obj.dtype == torch.float16
