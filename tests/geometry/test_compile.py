"""torch.compile, torch.export and CUDA give what eager PyTorch gives on a CPU."""

from __future__ import annotations

import io
import math
import shutil

import pytest
import torch

from flowrep.geometry import ego_flow, factorize, project, rigid_flow, unproject
from tests.geometry.scenes import HEIGHT, MOTION, OTHER_MOTION, WIDTH, K, depth_map

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("g++", "clang++", "c++"))),
    reason="inductor needs a C++ compiler, none found on PATH",
)


def inputs(*batch: int):
    """Returns depth with every mask, instance, K and motions `[*B, 3, 4, 4]`, float32."""
    depth = depth_map(*batch).float()
    depth[..., 0, 0, :4] = torch.tensor([math.inf, math.nan, 0.0, 0.2])
    instance = (torch.arange(HEIGHT * WIDTH) % 3).reshape(1, HEIGHT, WIDTH).to(torch.uint8)
    backed_off = MOTION.clone()
    backed_off[2, 3] = -0.5
    motions = torch.stack([backed_off, OTHER_MOTION, backed_off]).float()
    return depth, instance.expand_as(depth), K.float(), motions.expand(*batch, 3, 4, 4)


def everything(depth, instance, K, motions, dt=1.0):
    raw, raw_valid = rigid_flow(depth, instance, K, motions, dt=dt)
    ego, ego_valid = ego_flow(depth, K, motions[..., 0, :, :], dt=dt)
    return (
        raw,
        raw_valid,
        ego,
        ego_valid,
        *factorize(raw, depth, K, motions[..., 0, :, :], dt=dt),
    )


@pytest.fixture(autouse=True)
def _fresh_compiler():
    torch._dynamo.reset()


def assert_same(got, expected):
    for part, eager in zip(got, expected):
        torch.testing.assert_close(part, eager, rtol=0, atol=0, equal_nan=True)


def test_camera_is_one_graph():
    def there_and_back(depth, K):
        return (project(unproject(depth, K), K),)

    depth, _, camera, _ = inputs(2)
    compiled = torch.compile(there_and_back, fullgraph=True, backend="eager")
    assert_same(compiled(depth, camera), there_and_back(depth, camera))


@pytest.mark.slow_after_first
@pytest.mark.parametrize("dt", [1.0, 0.25, torch.tensor([0.5, 2.0])])
def test_flow_is_one_graph(dt):
    compiled = torch.compile(everything, fullgraph=True, backend="eager")
    assert_same(compiled(*inputs(2), dt), everything(*inputs(2), dt))


@pytest.mark.slow
def test_sizes_may_change_between_calls():
    compiled = torch.compile(ego_flow, fullgraph=True, backend="eager", dynamic=True)
    for height, width in [(5, 7), (4, 9)]:
        depth = torch.full((1, height, width), 3.0)
        expected = ego_flow(depth, K.float(), MOTION.float())
        assert_same(compiled(depth, K.float(), MOTION.float()), expected)


@pytest.mark.slow
@needs_compiler
def test_compiled_code_gives_the_bits_of_eager():
    compiled = torch.compile(everything, fullgraph=True)
    given = inputs(2)
    got, expected = compiled(*given), everything(*given)
    for part, eager in zip(got, expected):
        assert part.shape == eager.shape
        assert part.dtype == eager.dtype
    raw, raw_valid, ego, ego_valid, _, obj, valid = got
    assert torch.equal(raw_valid, expected[1])
    assert torch.equal(ego_valid, expected[3])
    assert torch.equal(valid, expected[6])
    torch.testing.assert_close(ego, expected[2], rtol=0, atol=1e-5)
    # Rows 0 and 2 are the camera's: the same bits, so no object flow at all.
    static = (given[1] != 1).expand_as(raw)
    assert torch.equal(raw.view(torch.int32)[static], ego.view(torch.int32)[static])
    assert obj[static].abs().max() == 0
    assert obj[~static & valid.expand_as(obj)].abs().min() > 0


@pytest.mark.slow
@needs_compiler
def test_compiled_code_reads_transposed_memory_right():
    depth, _, camera, motions = inputs(3)
    transposed = depth.mT.contiguous().mT
    compiled = torch.compile(ego_flow, fullgraph=True)
    got = compiled(transposed, camera, motions[:, 0])
    expected = ego_flow(depth, camera, motions[:, 0])
    assert torch.equal(got.valid, expected.valid)
    torch.testing.assert_close(got.flow, expected.flow, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_compiled_gradients_are_eager_s():
    compiled = torch.compile(ego_flow, fullgraph=True, backend="aot_eager")

    def gradients(function):
        depth, _, camera, motions = inputs(2)
        leaves = [depth.requires_grad_(), camera.requires_grad_(), motions[:, 0].requires_grad_()]
        function(*leaves).flow.square().sum().backward()
        return [leaf.grad for leaf in leaves]

    for got, expected in zip(gradients(compiled), gradients(ego_flow)):
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-3)


class Function(torch.nn.Module):
    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, *given):
        return tuple(self.function(*given))


@pytest.mark.slow
@pytest.mark.parametrize("dynamic", [False, True])
@pytest.mark.parametrize("function", [ego_flow, factorize])
def test_a_saved_program_gives_the_same_flow(function, dynamic):
    depth, motions = depth_map(3).float(), MOTION.float().repeat(3, 1, 1)
    depth[0, 0, 0, :3] = torch.tensor([torch.inf, torch.nan, 0.0])
    given = (depth, K.float().repeat(3, 1, 1), motions)
    if function is factorize:
        given = (torch.ones(3, 2, HEIGHT, WIDTH), *given)
    batch = torch.export.Dim("batch") if dynamic else None
    shapes = (({0: batch},) * len(given),) if dynamic else None
    program = torch.export.export(Function(function), given, dynamic_shapes=shapes)
    file = io.BytesIO()
    torch.export.save(program, file)
    file.seek(0)
    loaded = torch.export.load(file).module()
    for count in (3, 2) if dynamic else (3,):
        part = tuple(tensor[:count] for tensor in given)
        for got, want in zip(loaded(*part), function(*part)):
            assert torch.equal(got, want)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
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
