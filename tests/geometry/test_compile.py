"""torch.compile, torch.export and CUDA give what eager PyTorch gives on a CPU."""

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


def everything(depth, instance, K, motions, dt=1.0, prev_K=None):
    """Returns raw, where it is known, ego, obj, and where they are known."""
    before = {"prev_K": prev_K, "dt": dt}
    raw, raw_valid = rigid_flow(depth, instance, K, motions, **before)
    return raw, raw_valid, *factorize(raw, depth, K, motions[..., 0, :, :], **before)


@pytest.fixture(autouse=True)
def _fresh_compiler():
    torch._dynamo.reset()


def there_and_back(depth, instance, K, *motions):
    return (project(unproject(depth, K), K),)


@pytest.mark.parametrize(
    ("function", "more"),
    [
        (there_and_back, ()),
        (everything, (0.25, None)),
        pytest.param(
            everything, (torch.tensor([0.5, 2.0]), 1.1 * K.float()), marks=pytest.mark.slow
        ),
    ],
)
def test_each_function_is_one_graph(function, more):
    compiled = torch.compile(function, fullgraph=True, backend="eager")
    for got, eager in zip(compiled(*inputs(2), *more), function(*inputs(2), *more)):
        torch.testing.assert_close(got, eager, rtol=0, atol=0, equal_nan=True)


@pytest.mark.slow
@needs_compiler
def test_compiled_code_gives_the_bits_of_eager_from_transposed_memory_too():
    depth, instance, camera, motions = inputs(2)
    given = depth.mT.contiguous().mT, instance, camera, motions, 1.0, 1.1 * camera
    got, expected = torch.compile(everything, fullgraph=True)(*given), everything(*given)
    for part, eager in zip(got, expected):
        assert part.shape == eager.shape
        assert part.dtype == eager.dtype
        torch.testing.assert_close(part, eager, rtol=0, atol=1e-5)  # masks: equal
    raw, _, ego, obj, valid = got
    # Rows 0 and 2 are the camera's: the same bits, so no object flow at all.
    static = (instance != 1).expand_as(raw)
    assert torch.equal(raw.view(torch.int32)[static], ego.view(torch.int32)[static])
    assert obj[static].abs().max() == 0
    assert obj[~static & valid.expand_as(obj)].abs().min() > 0


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


class Factorize(torch.nn.Module):
    def forward(self, *given):
        return tuple(factorize(*given))


@pytest.mark.slow
def test_a_saved_program_gives_the_same_flow_for_batches_of_any_size():
    depth, motions = depth_map(3).float(), MOTION.float().repeat(3, 1, 1)
    depth[0, 0, 0, :3] = torch.tensor([torch.inf, torch.nan, 0.0])
    given = torch.ones(3, 2, HEIGHT, WIDTH), depth, K.float().repeat(3, 1, 1), motions
    batch = torch.export.Dim("batch")
    program = torch.export.export(Factorize(), given, dynamic_shapes=(({0: batch},) * 4,))
    file = io.BytesIO()
    torch.export.save(program, file)
    file.seek(0)
    loaded = torch.export.load(file).module()
    for count in (3, 2):
        part = tuple(tensor[:count] for tensor in given)
        for got, want in zip(loaded(*part), factorize(*part)):
            assert torch.equal(got, want)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("compiled", [False, True])
def test_equals_cpu(dtype, compiled):
    given = [part.to(dtype) if part.is_floating_point() else part for part in inputs()]
    on_gpu = torch.compile(everything, fullgraph=True) if compiled else everything
    got = on_gpu(*(tensor.cuda() for tensor in given))
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    for part, expected in zip(got, everything(*given)):
        assert part.is_cuda
        torch.testing.assert_close(part.cpu(), expected, rtol=tolerance, atol=tolerance)
    static = (given[1] != 1).expand_as(got[3])
    assert got[3].cpu()[static].abs().max() == 0  # object flow of what stands still
