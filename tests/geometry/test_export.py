"""torch.export: the programs of the flow functions are saved, loaded and give the same flow."""

import io

import pytest
import torch

from flowrep.geometry import ego_flow, factorize
from tests.geometry.scenes import HEIGHT, MOTION, WIDTH, K, depth_map


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
