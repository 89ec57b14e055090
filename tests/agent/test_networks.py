import pytest
import torch
import torch.nn.functional as F
from torchrl.data import Composite, Unbounded

from flowrep.agent.networks import Encoder, NatureEncoder
from flowrep.agent.observation import map_codecs


def codecs(*shapes):
    spec = Composite({f"map{i}": Unbounded(shape) for i, shape in enumerate(shapes)})
    return map_codecs(spec, list(spec.keys()), torch.float32)


def plain_nature(encoder, x):
    """The network as it is drawn in papers, in float64, flattened rows, columns, channels."""
    layers = {name: weight.double() for name, weight in encoder.named_parameters()}
    for name, stride in (("conv1", 4), ("conv2", 2), ("conv3", 1)):
        x = F.conv2d(x, layers[f"{name}.weight"], layers[f"{name}.bias"], stride)
        x = torch.where(x > 0, x, 0.01 * x)
    x = x.permute(0, 2, 3, 1).reshape(len(x), -1)
    x = x @ layers["linear.weight"].T + layers["linear.bias"]
    return torch.where(x > 0, x, 0.01 * x)


# 84: 20, 9, 7 pixels a side; 48: 11, 4, 2; 50 x 41: 11 x 9, 4 x 3, 2 x 1
@pytest.mark.parametrize(
    ("height", "width", "features"), [(84, 84, 3136), (48, 48, 256), (50, 41, 128)]
)
def test_encodes_like_the_plain_network(height, width, features):
    torch.manual_seed(2)
    (c,) = codecs((2, height, width))
    encoder = NatureEncoder(c)
    x = torch.randn(3, 2, height, width)
    assert encoder.linear.in_features == features
    expected = plain_nature(encoder, x.double())
    torch.testing.assert_close(encoder(c.decode(x)).double(), expected, rtol=1e-4, atol=1e-6)


def test_embeddings_stand_side_by_side_in_the_maps_order():
    torch.manual_seed(4)
    first, second = codecs((2, 40, 40), (1, 36, 44))
    encoder = Encoder([first, second])
    x, y = torch.randn(2, 2, 40, 40), torch.randn(2, 1, 36, 44)
    images = [first.decode(x), second.decode(y)]
    embedding = encoder(images)
    assert embedding.shape == (2, encoder.embedding_size) == (2, 1024)
    assert torch.equal(embedding[:, :512], encoder.encoders[0](images[0]))
    assert torch.equal(embedding[:, 512:], encoder.encoders[1](images[1]))


def test_a_normalised_embedding_has_mean_0_and_variance_1_whatever_the_scale_of_its_map():
    torch.manual_seed(3)
    two = codecs((2, 40, 44), (1, 40, 44))
    encoder = Encoder(two, layer_norm=True)
    images = [c.decode(torch.randn(5, *s)) for c, s in zip(two, [(2, 40, 44), (1, 40, 44)])]
    embedding = encoder([images[0] * 1000, images[1]]).reshape(5, 2, 512)
    torch.testing.assert_close(embedding.mean(-1), torch.zeros(5, 2), atol=1e-5, rtol=0)
    # of 512 numbers, 1e-5 added to the variance, which is small for the second map
    torch.testing.assert_close(embedding.var(-1, correction=0), torch.ones(5, 2), atol=0.1, rtol=0)
    assert len(list(encoder.parameters())) == len(list(Encoder(two).parameters()))


def probabilities(agent, maps):
    with torch.no_grad():
        return agent.policy.get_dist(maps.clone()).probs


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_any_leading_batch_acts_like_a_loop(make_agent, random_maps, batch):
    agent, maps = make_agent(), random_maps(*batch)
    probs = probabilities(agent, maps)
    assert probs.shape == (*batch, 3)
    looped = [probabilities(agent, one) for one in (maps.reshape(-1) if batch else [maps])]
    torch.testing.assert_close(probs.reshape(-1, 3), torch.stack(looped))
    assert agent.policy(maps)["action"].shape == batch


def test_writes_the_action_and_nothing_else(make_agent, random_maps):
    agent, maps = make_agent(), random_maps(2)
    assert set(agent.policy(maps.clone()).keys()) - set(maps.keys()) == {"action"}
