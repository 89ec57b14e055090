import pytest
import torch
from torchrl.data import Binary, Composite, Unbounded

from flowrep.agent.map_codec import map_codecs
from flowrep.agent.networks import Encoder
from flowrep.transforms import Mirror


def test_a_normalised_embedding_has_mean_0_and_variance_1_at_any_scale_of_its_map():
    torch.manual_seed(3)
    spec = Composite(large=Unbounded((2, 40, 44)), small=Unbounded((1, 40, 44)))
    two = map_codecs(spec, ["large", "small"], torch.float32)
    encoder = Encoder(two, layer_norm=True)
    images = [codec.decode(torch.randn(5, *spec[codec.key].shape)) for codec in two]
    embedding = encoder([images[0] * 1000, images[1]]).reshape(5, 2, 512)
    torch.testing.assert_close(embedding.mean(-1), torch.zeros(5, 2), atol=1e-5, rtol=0)
    # of 512 numbers, 1e-5 added to the variance, which is small for the second map
    torch.testing.assert_close(embedding.var(-1, correction=0), torch.ones(5, 2), atol=0.1, rtol=0)
    assert len(list(encoder.parameters())) == len(list(Encoder(two).parameters()))


def probabilities(agent, maps):
    with torch.no_grad():
        return agent.policy.get_dist(maps.clone()).probs


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_a_batch_acts_like_a_loop_over_it_and_writes_only_the_action(make_any, random_maps, batch):
    agent, maps = make_any(), random_maps(*batch)
    probs = probabilities(agent, maps)
    assert probs.shape == (*batch, 3)
    looped = [probabilities(agent, one) for one in (maps.reshape(-1) if batch else [maps])]
    torch.testing.assert_close(probs.reshape(-1, 3), torch.stack(looped))
    acted = agent.policy(maps.clone())
    assert acted["action"].shape == batch
    assert set(acted.keys()) - set(maps.keys()) - {"action_log_prob"} == {"action"}


def test_a_policy_with_a_mirror_takes_the_mean_of_both_sides(make_agent, random_maps):
    agent, maps = make_agent(), random_maps(4)
    image = maps.clone()
    image["seg"] = maps["seg"].flip(-1)
    image["flow"] = maps["flow"].flip(-1) * torch.tensor([-1.0, 1.0])[:, None, None]  # u and v
    here, there = (probabilities(agent, each).log() for each in (maps, image))
    options = {"flow_keys": "flow", "swapped_actions": [0, 2, 1]}
    agent.policy[0].module.mirror = Mirror(["flow", "seg"], **options)
    expected = ((here + there[:, [0, 2, 1]]) / 2).softmax(-1)
    torch.testing.assert_close(probabilities(agent, maps), expected)
    assert not torch.allclose(expected, here.exp(), atol=1e-4)


def test_an_action_of_several_choices_is_refused(make_agent):
    with pytest.raises(TypeError, match="Binary"):
        make_agent(action_spec=Binary(3))
