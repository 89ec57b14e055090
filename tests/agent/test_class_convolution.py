"""Convolutions of class ids by look-up, against PyTorch's of their one-hot maps in float64."""

import pytest
import torch
import torch.nn.functional as F

from flowrep.agent import class_convolution
from flowrep.agent.class_convolution import ClassConvolution, one_hot

CLASSES, NO_CLASS = 3, 255


def test_the_one_hot_map_of_an_id_is_that_of_its_channel():
    ids = torch.tensor([[[[2, NO_CLASS]], [[0, 3]]]], dtype=torch.uint8)  # two channels of 1 x 2
    seen = one_hot(ids, CLASSES, torch.float32)
    assert seen.is_contiguous(memory_format=torch.channels_last)
    assert seen[0, :, 0].T.tolist() == [[0, 0, 1, 1, 0, 0], [0, 0, 0, 0, 0, 0]]


def test_a_weight_is_looked_up_at_its_place_in_the_kernel():
    # One channel; weight of class 1 at kernel row 1, column 2 for output 1: only it is read.
    weight = torch.zeros(2, CLASSES, 2, 3)
    weight[1, 1, 1, 2] = 7.0
    ids = torch.zeros(1, 1, 3, 5, dtype=torch.uint8)
    ids[0, 0, 2, 3] = 1  # row 2 - 1 = 1, column 3 - 2 = 1 of the output
    y = ClassConvolution(weight, torch.tensor([0.5, 0.25]), 1)(ids)
    assert y[0, 0].tolist() == [[0.5] * 3] * 2
    assert y[0, 1].tolist() == [[0.25] * 3, [0.25, 7.25, 0.25]]


@pytest.mark.parametrize("has_numba", [True, False])
@pytest.mark.parametrize(("height", "width"), [(2, 3), (1, 1), (3, 2)])
def test_it_is_the_convolution_of_one_hot_maps(monkeypatch, height, width, has_numba):
    if not has_numba:
        monkeypatch.setattr(class_convolution, "numba_is_installed", lambda: False)
        monkeypatch.setattr(class_convolution, "IDS_A_PRODUCT", 20)  # and so several products
    torch.manual_seed(0)
    ids = torch.randint(0, CLASSES + 1, (4, 6, 5, 2), dtype=torch.uint8).permute(0, 3, 1, 2)
    ids[1, 0, 2, 3] = NO_CLASS
    weight, bias = torch.randn(7, 2 * CLASSES, height, width), torch.randn(7)
    ours = ClassConvolution(weight, bias, 2)
    seen, weight64 = one_hot(ids, CLASSES, torch.float64), weight.double().requires_grad_()
    expected = F.conv2d(seen, weight64, bias.double())
    y = ours(ids)
    assert y.is_contiguous(memory_format=torch.channels_last)
    torch.testing.assert_close(y.double(), expected, rtol=1e-5, atol=1e-5)
    assert ours.size_after(6, 5) == tuple(expected.shape[2:])
    g = torch.randn_like(expected)
    expected.backward(g)
    gradient = ours.weight_gradient(g.float(), ids)
    torch.testing.assert_close(gradient.double(), weight64.grad, rtol=1e-5, atol=1e-5)


def test_an_output_does_not_depend_on_its_batch():
    torch.manual_seed(1)
    ids = torch.randint(0, CLASSES, (9, 2, 5, 5), dtype=torch.uint8)
    ours = ClassConvolution(torch.randn(7, 2 * CLASSES, 2, 2), torch.randn(7), 2)
    assert torch.equal(ours(ids)[4:5], ours(ids[4:5]))
