"""Segmentation, depth and colour: values worked by hand, specs that tell the truth."""

import math
import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical
from torchrl.envs import Compose, TransformedEnv

from flowrep.transforms import Depth, InstanceIds, Rgb, Segmentation
from tests.transforms.fake_env import NUM_CLASSES, FakeSensorEnv


def read(transform, name: str, value: torch.Tensor) -> torch.Tensor:
    td = transform(TensorDict({"sensor": {name: value}}))
    return td[transform.out_keys[0]]


def test_specs_say_how_many_classes_there_are_or_which_values():
    onehot = Segmentation(NUM_CLASSES, encoding="onehot", out_keys="onehot")
    stack = Compose(Segmentation(NUM_CLASSES), onehot, Depth(), Rgb())
    spec = TransformedEnv(FakeSensorEnv((3,)), stack).observation_spec
    assert spec["seg"] == Categorical(NUM_CLASSES, shape=(3, 1, 5, 7), dtype=torch.uint8)
    assert spec["onehot"] == Bounded(0.0, 1.0, shape=(3, NUM_CLASSES, 5, 7))
    assert spec["depth"] == Bounded(0.0, 1.0, shape=(3, 1, 5, 7))
    assert spec["rgb"] == Bounded(0, 255, shape=(3, 3, 5, 7), dtype=torch.uint8)


@pytest.mark.parametrize("dtype", [torch.uint16, torch.uint32, torch.int64])
def test_whole_numbers_of_any_type_are_read(dtype):
    ids = torch.tensor([[[0, 2, 1]]]).to(dtype)
    assert read(Segmentation(3), "semantic", ids).tolist() == [[[0, 2, 1]]]
    onehot = read(Segmentation(3, encoding="onehot"), "semantic", ids)
    assert onehot.argmax(0).tolist() == [[0, 2, 1]]
    rows = read(
        InstanceIds([2, 1], in_keys=("sensor", "instance"), out_keys="rows"), "instance", ids
    )
    assert rows.tolist() == [[[0, 1, 2]]]
    picture = torch.full((3, 2, 2), 255).to(dtype)
    assert read(Rgb(), "rgb", picture).unique().tolist() == [255]
    with pytest.raises(ValueError, match=r"'rgb'\) holds values from 3000 to 3000.*257"):
        read(Rgb(), "rgb", torch.full((3, 2, 2), 3000).to(dtype))


@pytest.mark.parametrize(
    ("ids", "said"),
    [
        (torch.tensor([0, 300, 7], dtype=torch.int32), "from 0 to 300"),  # 300 would be 44
        (torch.tensor([2, -1, 1], dtype=torch.int8), "from -1 to 2"),  # -1 would be 255
    ],
)
def test_ids_that_uint8_can_not_hold_are_refused(ids, said):
    ids = ids.reshape(1, 1, 3)
    with pytest.raises(ValueError, match=rf"'semantic'\) holds class ids {said}.*to 255"):
        read(Segmentation(3), "semantic", ids)
    assert read(Segmentation(3), "semantic", ids.clamp(0, 2)).dtype == torch.uint8
    onehot = read(Segmentation(3, encoding="onehot"), "semantic", ids)  # narrows nothing
    assert onehot[:, 0, 1].tolist() == [0, 0, 0]


def test_depth_is_clipped_and_finite():
    depth = torch.tensor([[[10.0, 50.0, -4.0], [40.0, math.inf, math.nan]]])
    got = read(Depth(range_m=40.0, missing=0.75), "depth", depth)
    assert got.tolist() == [[[0.25, 1.0, 0.0], [1.0, 1.0, 0.75]]]
    assert read(Depth(), "depth", depth)[0, 1, 2] == 0.0


def rows_of(ids, body_ids, **options):
    transform = InstanceIds(body_ids, in_keys="ids", **options)
    td = TensorDict(ids=torch.tensor(ids, dtype=torch.int32).reshape(1, 1, -1))
    return transform(td)["sensor", "instance"].flatten().tolist()


# PyBullet's ids with links: body + (link + 1) * 2^24. Body 3's base, its links 0 and 2, body 5's
# base and link 0, the floor 0 and the background.
LINKS = [3, 3 + 2**24, 3 + 3 * 2**24, 5, 5 + 2**24, 0, -1]


def test_pybullets_links_take_the_rows_of_their_bodies_or_their_own():
    assert rows_of(LINKS, [5, 3], links_as_body=True) == [2, 2, 2, 1, 1, 0, 0]
    each = [(3, 2), (5, -1), (3, -1), (3, 0), (5, 0)]
    assert rows_of(LINKS, each) == [3, 4, 1, 2, 5, 0, 0]
    # link 2 has a row of its own, the others move as their bodies
    assert rows_of(LINKS, [3, (3, 2), 5], links_as_body=True) == [1, 1, 2, 3, 3, 0, 0]


@pytest.mark.parametrize("seen", [LINKS, [3, 0, 5 + 2**24]])
def test_links_of_a_body_that_is_named_without_them_are_refused(seen):
    with pytest.raises(ValueError, match=r"body \d, link 0.*links_as_body=True"):
        rows_of(seen, [5, 3])


def test_ids_without_a_row_are_named_once_with_their_share():
    transform = InstanceIds([17], in_keys=("sensor", "semantic"))
    td = TensorDict({"sensor": {"semantic": torch.tensor([[[17, 4, 4, 9, -1, 0, 17, 17]]])}})
    with pytest.warns(UserWarning, match=r"4 \(25.0%\), 9 \(12.5%\).*static_ids") as told:
        transform(td.clone())
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(250):
            transform(td.clone())
        rows_of([17, 4, 9, -1, 0], [17], static_ids=[0, 4, 9])
    other = td.clone()
    other["sensor", "semantic"][0, 0, 0] = 5  # a body that has come later
    with pytest.warns(UserWarning, match=r"\b5 \(12.5%\)") as told:
        [transform(other.clone()) for _ in range(100)]
    assert len(told) == 1
