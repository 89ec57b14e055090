"""Mirror: left-right images of transitions, worked out by hand."""

import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose

from flowrep import geometry
from flowrep.transforms import Mirror
from flowrep.transforms.base import MissingKey
from tests.transforms.fake_env import FakeSensorEnv

SWAPPED = [0, 2, 1]  # straight on, left, right


def camera(cx: float) -> list[list[float]]:
    return [[6.0, 0.0, cx], [0.0, 5.0, 2.1], [0.0, 0.0, 1.0]]


def transitions(*batch: int) -> TensorDict:
    """Random flows of two frames, ids and actions, now and next; 2 rows, 5 columns."""
    steps = {
        "raw": torch.randn(*batch, 4, 2, 5),
        "seg": torch.randint(9, (*batch, 1, 2, 5), dtype=torch.uint8),
    }
    following = {key: x.roll(1, -2) + 1 for key, x in steps.items()}
    following["reward"] = torch.randn(*batch, 1)
    return TensorDict({**steps, "action": torch.randint(3, batch), "next": following}, batch)


def mirror(images="all", **options) -> Mirror:
    keys = {"in_keys": ["raw", "seg"], "flow_keys": "raw", "swapped_actions": SWAPPED}
    return Mirror(images=images, **keys | options)


def image(td: TensorDict) -> TensorDict:
    """The images of `transitions`, by a centred camera, in other words than the transform's."""
    sign = torch.tensor([-1.0, 1.0, -1.0, 1.0])[:, None, None]
    out = td.clone()
    for place in (out, out["next"]):
        place["raw"], place["seg"] = place["raw"].flip(-1) * sign, place["seg"].flip(-1)
    out["action"] = torch.where(td["action"] == 0, 0, 3 - td["action"])
    return out


def same(a: TensorDict, b: TensorDict) -> bool:
    return bool((a == b).all())


def test_an_env_refuses_it():
    seen = Mirror([("sensor", "depth")], swapped_actions=SWAPPED)
    with pytest.raises(RuntimeError, match="replay"):
        TransformedEnv(FakeSensorEnv(), seen).rollout(2)


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_any_batch_has_its_image(batch):
    td = transitions(*batch)
    assert same(mirror()(td.clone()), image(td))
    assert same(Compose(mirror())(td.clone()), image(td))
    raw, seg = mirror().images_of([td["raw"], td["seg"]])  # of maps alone
    assert torch.equal(raw, image(td)["raw"])
    assert torch.equal(seg, image(td)["seg"])


def test_a_replay_buffer_stores_what_was_seen_and_samples_images():
    td = transitions(6)
    td["number"] = torch.arange(6)
    storage, seen = LazyTensorStorage(6), pickle.loads(pickle.dumps(mirror()))
    buffer = TensorDictReplayBuffer(storage=storage, transform=seen, batch_size=40)
    buffer.extend(td)
    assert torch.equal(storage[:]["raw"], td["raw"])
    sample = buffer.sample()
    want = image(td)[sample["number"]]
    assert same(sample.select(*want.keys(True, True)), want)


# What an image is


@pytest.mark.parametrize(
    ("cx", "seen"),
    [
        (2.5, [4, 3, 2, 1, 0]),  # the centre of five columns: reversed
        # flowrep's renderer samples pixels at their left edges, cx = W / 2 + 0.5: column i shows
        # what W - i showed, and column 5 was not seen. Reversing alone would be one column off.
        (3.0, [4, 4, 3, 2, 1]),
        (2.0, [3, 2, 1, 0, 0]),
    ],
)
def test_the_columns_of_an_image(cx, seen):
    td = TensorDict({"seg": torch.arange(5).reshape(1, 1, 5), "action": torch.tensor(0)})
    mirrored = Mirror("seg", swapped_actions=SWAPPED, intrinsics=camera(cx), images="all")(td)
    assert mirrored["seg"].flatten().tolist() == seen


def test_ego_flow_of_the_image_is_the_image_of_ego_flow():
    # cx = 3 and seven columns: the last sees what none on the left did
    K, width = torch.tensor(camera(3.0)), 7
    depth = 2 + torch.rand(1, 5, width)
    turn, reflect = torch.eye(4), torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))
    turn[0, 0] = turn[2, 2] = torch.cos(torch.tensor(0.2))
    turn[0, 2], turn[2, 0] = torch.sin(torch.tensor(0.2)), -torch.sin(torch.tensor(0.2))
    turn[:3, 3] = torch.tensor([0.3, -0.1, 0.5])
    td = TensorDict({"ego": geometry.ego_flow(depth, K, turn).flow, "depth": depth})
    td["action"] = torch.tensor(1)
    seen = Mirror(
        ["ego", "depth"], flow_keys="ego", swapped_actions=SWAPPED, intrinsics=K, images="all"
    )(td)
    there = geometry.ego_flow(seen["depth"], K, reflect @ turn @ reflect).flow
    torch.testing.assert_close(there[..., :-1], seen["ego"][..., :-1], atol=1e-5, rtol=1e-5)


def test_actions_in_any_layout_and_their_masks_are_exchanged_and_continuous_ones_refused():
    td = transitions(3)
    td["action_mask"] = torch.tensor([[True, True, False]]).expand(3, 3)
    td["next", "action_mask"] = torch.tensor([[False, False, True]]).expand(3, 3)
    one_hot = mirror()(td.clone().set("action", torch.eye(3, dtype=torch.bool)))
    column = mirror()(td.clone().set("action", torch.tensor([[0], [1], [2]])))
    assert one_hot["action"].int().argmax(-1).tolist() == [0, 2, 1]
    assert column["action"].tolist() == [[0], [2], [1]]
    for image in (one_hot, column):
        assert image["action_mask"].tolist() == [[True, False, True]] * 3
        assert image["next", "action_mask"].tolist() == [[False, True, False]] * 3
    td["action"] = torch.tensor([[0.7], [-0.4], [0.1]])
    with pytest.raises(TypeError, match=r"discrete actions, got torch\.float32"):
        mirror()(td)


# Which transitions


def test_half_of_a_batch_is_replaced_whole_transitions_at_a_time():
    td = transitions(400)
    torch.manual_seed(3)
    got = mirror("half")(td.clone())
    chosen = (got["raw"] != td["raw"]).flatten(1).any(-1)
    assert 150 < chosen.sum() < 250
    assert same(got[chosen], image(td)[chosen])
    assert same(got[~chosen], td[~chosen])
    torch.manual_seed(3)
    assert same(mirror("half")(td.clone()), got)


def test_a_trajectory_is_mirrored_as_a_whole():
    td = transitions(64, 3)
    td.names = [None, "time"]
    got = mirror("half")(td.clone())
    changed = (got["raw"] != td["raw"]).flatten(2).any(-1)
    assert (changed.all(-1) == changed.any(-1)).all()
    assert 0 < changed.sum() < changed.numel()


def test_a_batch_may_lack_the_next_maps_but_not_its_own():
    td = transitions(3)
    rest = mirror()(td.clone().exclude(("next", "raw"), ("next", "seg")))
    assert torch.equal(rest["raw"], image(td)["raw"])
    assert same(rest["next"], td["next"].select("reward"))
    for key in ("raw", "seg"):  # the first and the last
        incomplete = td.exclude(key)
        before = incomplete.clone()
        with pytest.raises(MissingKey, match=key):
            mirror()(incomplete)
        assert same(incomplete, before)


def test_a_picture_of_another_width_than_the_camera_s_maps_is_refused():
    K = [[40.0, 0.0, 20.0], [0.0, 40.0, 20.0], [0.0, 0.0, 1.0]]
    mirror = Mirror(["seg", "rgb"], swapped_actions=SWAPPED, intrinsics=K)
    td = TensorDict({"seg": torch.zeros(4, 1, 40, 40), "action": torch.zeros(4).long()}, [4])
    td["rgb"] = torch.zeros(4, 3, 160, 160)  # as drawn for estimated flow
    with pytest.raises(ValueError, match=r"'rgb' is 160 pixels wide, but 2·cx is 40"):
        mirror(td)
