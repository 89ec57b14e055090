"""Segmentation, depth and colour: values worked by hand, specs that tell the truth."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical
from torchrl.envs import TransformedEnv

from flowrep.transforms import Depth, Rgb, Segmentation
from tests.transforms.fake_env import NUM_CLASSES, FakeSensorEnv


def read(transform, name: str, value: torch.Tensor) -> torch.Tensor:
    td = transform(TensorDict({"sensor": {name: value}}))
    return td[transform.out_keys[0]]


SPECS = {
    "ids": (
        lambda: Segmentation(NUM_CLASSES),
        Categorical(NUM_CLASSES, shape=(3, 1, 5, 7), dtype=torch.uint8),
    ),
    "onehot": (
        lambda: Segmentation(NUM_CLASSES, encoding="onehot"),
        Bounded(0.0, 1.0, shape=(3, NUM_CLASSES, 5, 7)),
    ),
    "depth": (Depth, Bounded(0.0, 1.0, shape=(3, 1, 5, 7))),
    "rgb": (Rgb, Bounded(0, 255, shape=(3, 3, 5, 7), dtype=torch.uint8)),
}


@pytest.mark.parametrize(("make", "want"), SPECS.values(), ids=list(SPECS))
def test_specs_say_how_many_classes_there_are_or_which_values(make, want):
    transform = make()
    env = TransformedEnv(FakeSensorEnv((3,)), transform)
    assert env.observation_spec[transform.out_keys[0]] == want


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


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"num_classes": 3, "encoding": "rgb"}, r"\['ids', 'onehot'\], got 'rgb'"),
        ({"num_classes": 257}, "1 to 256"),
        ({"range_m": math.inf}, "range_m must be a positive"),
        ({"missing": 1.5}, r"missing must be in \[0, 1\]"),
    ],
)
def test_options_are_checked(options, expected):
    with pytest.raises(ValueError, match=expected):
        (Segmentation if "num_classes" in options else Depth)(**options)


def test_depth_is_clipped_and_finite():
    depth = torch.tensor([[[10.0, 50.0, -4.0], [40.0, math.inf, math.nan]]])
    got = read(Depth(range_m=40.0, missing=0.75), "depth", depth)
    assert got.tolist() == [[[0.25, 1.0, 0.0], [1.0, 1.0, 0.75]]]
    assert read(Depth(), "depth", depth)[0, 1, 2] == 0.0
