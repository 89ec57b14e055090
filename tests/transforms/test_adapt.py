"""Adapters as transforms: what they hand to geometry, and what they refuse."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs.transforms import Compose

from flowrep import transforms as T
from tests.transforms.fake_env import INTRINSICS

POSE = ("sensor", "world_from_cam")


def test_millimetres_with_channels_last_become_metres():
    adapt = T.AdaptDepth("z", scale_m=1e-3, nothing=0, channels_last=True)
    picture = torch.tensor([[0, 1500, 2000], [2500, 3000, 3500]], dtype=torch.int16)
    z = adapt(TensorDict(depth=picture[None, ..., None], batch_size=[1]))["sensor", "depth"]
    assert z.shape == (1, 1, 2, 3)
    assert z[0, 0, 1].tolist() == [2.5, 3.0, 3.5]
    assert z[0, 0, 0, 0].isnan()
    spec = Composite(depth=Unbounded((2, 3, 1), dtype=torch.int16))
    assert adapt.transform_observation_spec(spec)["sensor", "depth"].shape == (1, 2, 3)


def test_intrinsics_of_each_sample_may_lie_under_a_key():
    # fx = 3 and 4: the last pixel looks along x = 1 and 0.75, a ray of sqrt(2) and 1.25.
    K = torch.tensor([[3.0, 0.0, 2.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]]).repeat(2, 1, 1)
    K[1, 0, 0] = 4.0
    td = TensorDict({"ray": torch.full((2, 1, 1, 6), 5.0), "K": K}, [2])
    z = T.AdaptDepth("ray_length", intrinsics="K", in_keys="ray")(td)["sensor", "depth"]
    torch.testing.assert_close(z[:, 0, 0, 5], torch.tensor([5.0 / math.sqrt(2), 4.0]))


@pytest.mark.parametrize("layout", ["matrix", "xyz_wxyz"])
def test_a_body_may_be_absent_but_a_camera_may_not(layout):
    good = torch.eye(4) if layout == "matrix" else torch.tensor([5.0, 6, 7, 1, 0, 0, 0])
    absent = torch.full_like(good, math.nan)
    adapt = T.AdaptPose(layout=layout)
    bodies = torch.stack([absent, good, good])[None]
    td = TensorDict({"pose": bodies}, [1])
    assert adapt(td.clone())[POSE].isnan().any(-1).any(-1).tolist() == [[True, False, False]]
    assert POSE in adapt._reset(td, TensorDict({"pose": absent.expand_as(bodies)}, [1])).keys(True)
    bodies[0, 2].view(-1)[0] = math.nan  # a part of a pose is unknown
    with pytest.raises(ValueError, match=r"pose\[0, 2\]"):
        adapt(td.clone())
    with pytest.raises(ValueError, match="pose"):
        adapt(TensorDict({"pose": absent[None]}, [1]))


def test_flow_with_channels_last_is_turned():
    vectors = torch.zeros(1, 2, 3, 2)
    vectors[0, 1, 2] = torch.tensor([-3.0, -1.0])  # backward: 3 px to the right and 1 px down
    adapt = T.AdaptFlow(direction="backward", grid="current", channels_last=True)
    raw = adapt(TensorDict(flow=vectors, batch_size=[1]))["raw"]
    assert raw.shape == (1, 2, 2, 3)
    assert raw[0, :, 1, 2].tolist() == [3.0, 1.0]
    spec = Composite(flow=Unbounded((2, 3, 2), dtype=torch.float64))  # the env's precision stays
    want = Unbounded((2, 2, 3), dtype=torch.float64)
    assert adapt.transform_observation_spec(spec)["raw"] == want


@pytest.mark.parametrize("ids", [[7], [7, 12, 31]])
def test_a_number_of_ids_that_is_not_that_of_the_bodies_is_refused(ids):
    spec = Composite(
        sensor=Composite(
            depth=Unbounded((1, 5, 7)), instance_motion=Unbounded((3, 4, 4)), shape=()
        ),
        segmentation=Unbounded((1, 5, 7), dtype=torch.int32),
    )
    rows = T.InstanceIds(ids).transform_observation_spec(spec)["sensor", "instance"]
    assert rows == Categorical(1 + len(ids), shape=(1, 5, 7), dtype=torch.uint8)
    stack = Compose(T.InstanceIds(ids), T.RawFlow(INTRINSICS))
    with pytest.raises(ValueError, match="InstanceIds"):
        stack.transform_observation_spec(spec)


def body_at(x):
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 3] = x
    return matrix


def test_a_body_keeps_its_row_and_a_row_is_empty_for_a_step_before_another_takes_it():
    rows = T.BodyRows(2)
    steps = [{"a": 1, "b": 2}, {"b": 3}, {"c": 7, "b": 4}, {"d": 9, "c": 8}]
    seen = [rows({name: body_at(x) for name, x in step.items()})[:, 0, 3] for step in steps[:3]]
    assert [one.nan_to_num(-1).tolist() for one in seen] == [[1, 2], [-1, 3], [7, 4]]
    with pytest.raises(ValueError, match=r"BodyRows\(3\)"):
        # in the row of b, motion from 4 m to 9 m would be a jump that nobody made
        rows({name: body_at(x) for name, x in steps[3].items()})
    rows.clear()
    assert rows({"d": body_at(6)})[0, 0, 3] == 6


def test_labels_follow_their_bodies_from_frame_to_frame():
    rows = T.BodyRows(2)
    rows({"a": body_at(1), "b": body_at(2)})
    picture = torch.tensor([[[0, 200, 7]]], dtype=torch.uint8)
    assert rows.instance(picture, {200: "b", 7: "a"}).tolist() == [[[0, 2, 1]]]
    assert rows.instance(picture, {200: "a", 7: "b"}).tolist() == [[[0, 1, 2]]]
    assert rows.instance(picture, {200: "gone"}).tolist() == [[[0, 0, 0]]]
