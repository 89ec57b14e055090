"""The layers that a team shares, against PyTorch's own in float64."""

import pytest
import torch
import torch.nn.functional as F

from flowrep.agent import layers
from flowrep.agent.class_convolution import one_hot
from flowrep.agent.layers import convolve, linear

STRIDES = (1, 2, 1)
TIGHT = {"rtol": 1e-5, "atol": 1e-5}


def chain(channels):
    """Three convolutions with kernels that are no squares."""
    shapes = [(6, channels, 2, 2), (5, 6, 4, 3), (7, 5, 3, 2)]
    weights = [torch.randn(shape, requires_grad=True) for shape in shapes]
    biases = [torch.randn(shape[0], requires_grad=True) for shape in shapes]
    return [tensor for layer in zip(weights, biases) for tensor in layer]


def image(size, channels, height, width):
    return torch.randn(size, height, width, channels).permute(0, 3, 1, 2)


def plain(x, weights):
    """Features and gradients by PyTorch, in float64."""
    weights = [w.detach().double().requires_grad_() for w in weights]
    x = x.double()
    for stride, w, b in zip(STRIDES, weights[::2], weights[1::2]):
        x = F.leaky_relu(F.conv2d(x, w, b, stride))
    features = x.permute(0, 2, 3, 1).flatten(1)
    weighed(features).backward()
    return features, [w.grad for w in weights]


def weighed(features):
    """A sum in which every feature of every image counts differently."""
    rows = torch.arange(1, len(features) + 1).unsqueeze(1)
    columns = torch.linspace(-1, 2, features.shape[1])
    return (features * rows * columns).sum()


@pytest.mark.parametrize("images_a_part", [1, 3, 100])
def test_two_maps_are_convolved_like_by_pytorch(monkeypatch, images_a_part):
    # the largest map of a chain is its first: 6 channels of 10 x 8 float32
    monkeypatch.setattr(layers, "CACHE_BYTES", images_a_part * 6 * 10 * 8 * 4)
    torch.manual_seed(0)
    images = [image(7, 3, 11, 9), image(7, 4, 10, 9)]
    weights = [chain(3), chain(4)]
    features = convolve(images, [w for ws in weights for w in ws], STRIDES, torch.float32)
    sum(weighed(f) for f in features).backward()
    for x, ws, actual in zip(images, weights, features):
        expected, gradients = plain(x, ws)
        for a, b in zip([actual, *(w.grad for w in ws)], [expected, *gradients]):
            assert (a - b).abs().max() < 1e-6 * b.abs().max()


@pytest.mark.parametrize("shared_out", [True, False], ids=["team", "export"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_ids_are_convolved_like_their_one_hot_maps(monkeypatch, dtype, shared_out):
    monkeypatch.setattr(layers, "CACHE_BYTES", 3 * 6 * 10 * 8 * dtype.itemsize)  # three images
    monkeypatch.setattr(layers, "_is_shared_out", lambda x: shared_out)
    torch.manual_seed(4)
    ids = torch.randint(0, 5, (7, 11, 9, 3), dtype=torch.uint8).permute(0, 3, 1, 2)
    ids[2, 1, 4, 3] = 200  # of four classes: 4 and 200 are none
    images, weights = [ids, image(7, 3, 11, 9).to(dtype)], [chain(3 * 4), chain(3)]
    features = convolve(images, [w for ws in weights for w in ws], STRIDES, dtype)
    sum(weighed(f) for f in features).backward()
    expected, gradients = plain(one_hot(ids, 4, torch.float64), weights[0])
    assert features[0].dtype is dtype
    # eight bits of mantissa, six layers there and back
    tolerance = 1e-6 if dtype is torch.float32 else 0.1
    for a, b in zip([features[0], *(w.grad for w in weights[0])], [expected, *gradients]):
        assert (a - b).norm() < tolerance * b.norm()


def test_an_image_with_gradients_gets_them():
    torch.manual_seed(1)
    weights, x = chain(3), image(2, 3, 11, 9)
    (without,) = convolve([x], weights, STRIDES, torch.float32)
    (features,) = convolve([x.requires_grad_()], weights, STRIDES, torch.float32)
    torch.testing.assert_close(features, without, **TIGHT)
    weighed(features).backward()
    assert x.grad.abs().sum() > 0


def test_nothing_is_kept_without_gradients():
    with torch.no_grad():
        (features,) = convolve([image(2, 3, 11, 9)], chain(3), STRIDES, torch.float32)
    assert features.grad_fn is None


@pytest.mark.parametrize("rows", [2, 100])
def test_a_linear_layer_is_pytorchs(monkeypatch, rows):
    monkeypatch.setattr(layers, "ROWS", rows)
    monkeypatch.setattr(layers, "FEATURES", rows)
    torch.manual_seed(2)
    x, w, b = (torch.randn(s, requires_grad=True) for s in ((5, 4), (3, 4), (3,)))
    y = linear(x, w, b)
    weighed(y).backward()
    x64, w64, b64 = (t.detach().double().requires_grad_() for t in (x, w, b))
    expected = F.linear(x64, w64, b64)
    weighed(expected).backward()
    torch.testing.assert_close(y.double(), expected, **TIGHT)
    for tensor, reference in ((x, x64), (w, w64), (b, b64)):
        torch.testing.assert_close(tensor.grad.double(), reference.grad, **TIGHT)


def test_only_the_gradients_that_are_asked_for_are_computed():
    x, w, b = torch.randn(5, 4), torch.randn(3, 4), torch.randn(3, requires_grad=True)
    linear(x, w, b).sum().backward()
    assert b.grad.tolist() == [5, 5, 5]
    assert x.grad is None
    assert w.grad is None


def test_weights_get_float32_gradients_of_bfloat16_layers():
    torch.manual_seed(3)
    weights, x = chain(3), image(4, 3, 11, 9)
    (features,) = convolve([x.bfloat16()], weights, STRIDES, torch.bfloat16)
    assert features.dtype is torch.bfloat16
    weighed(features).backward()
    _, gradients = plain(x, weights)
    for w, gradient in zip(weights, gradients):
        assert w.grad.dtype is torch.float32
        # eight bits of mantissa, six layers there and back
        assert (w.grad - gradient).norm() < 0.05 * gradient.norm()
