"""The same on a GPU."""

import pytest
import torch

from flowrep.geometry import ego_flow, factorize, project, rigid_flow, unproject
from tests.geometry.scenes import HEIGHT, MOTION, OTHER_MOTION, WIDTH, K, depth_map

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("compiled", [False, True])
def test_equals_cpu(dtype, compiled):
    instance = (torch.arange(HEIGHT * WIDTH) % 3).reshape(1, HEIGHT, WIDTH)
    motions = torch.stack([MOTION, OTHER_MOTION, MOTION]).to(dtype)

    def everything(depth, instance, K, motions):
        raw, valid = rigid_flow(depth, instance, K, motions)
        factors = factorize(raw, depth, K, motions[0])
        points = unproject(depth, K)
        return raw, valid, *factors, points, project(points, K), ego_flow(depth, K, motions[0]).flow

    given = [depth_map().to(dtype), instance, K.to(dtype), motions]
    on_gpu = torch.compile(everything, fullgraph=True) if compiled else everything
    got = on_gpu(*(tensor.cuda() for tensor in given))
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    for part, expected in zip(got, everything(*given)):
        assert part.is_cuda
        torch.testing.assert_close(part.cpu(), expected, rtol=tolerance, atol=tolerance)
    static = (instance != 1).expand_as(got[3])
    assert got[3].cpu()[static].abs().max() == 0  # object flow of what stands still
