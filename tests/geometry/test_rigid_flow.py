"""Flow of moving bodies: each pixel with its body's motion, and bit for bit ego flow elsewhere."""

import math
from itertools import product

import pytest
import torch

from flowrep.geometry import ego_flow, rigid_flow
from tests.geometry.scenes import HEIGHT, MOTION, OTHER_MOTION, WIDTH, K, depth_map, rigid


def instance_map(*batch: int, count: int = 3, dtype=torch.uint8) -> torch.Tensor:
    generator = torch.Generator().manual_seed(4)
    return torch.randint(count, (*batch, 1, HEIGHT, WIDTH), generator=generator).to(dtype)


MOTIONS = torch.stack([MOTION, OTHER_MOTION, rigid((0.1, 0.0, 0.2), (1.0, 2.0, 0.5))])


def test_body_by_hand():
    # Two pixels at 4 m, a still camera. Body 1 stood 1 m higher (y down: -1) and 0.5 m further
    # left: it came down and to the right, (4 * 0.5/4, 8 * 1/4). With the ids swapped the first
    # pixel would move; with world y up, v would be -2.
    camera = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 0.25], [0.0, 0.0, 1.0]])
    motions = torch.eye(4).repeat(2, 1, 1)
    motions[1, :2, 3] = torch.tensor([-0.5, -1.0])
    flow, _ = rigid_flow(torch.full((1, 1, 2), 4.0), torch.tensor([[[0, 1]]]), camera, motions)
    assert flow[:, 0].T.tolist() == [[0.0, 0.0], [0.5, 2.0]]


def test_every_pixel_has_the_flow_of_its_own_body():
    depth, instance = depth_map(), instance_map()
    flow, valid = rigid_flow(depth, instance, K, MOTIONS)
    assert valid.all()
    for number, motion in enumerate(MOTIONS):
        riding = (instance == number).expand_as(flow)
        assert riding.any()
        assert torch.equal(flow[riding], ego_flow(depth, K, motion).flow[riding])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bits_are_those_of_ego_flow_where_a_row_is_the_camera_s(dtype):
    depth, camera = depth_map(4).to(dtype), K.to(dtype)
    depth[0, 0, 0, :3] = torch.tensor([math.inf, math.nan, 1e-3])
    rows = torch.stack([MOTION, OTHER_MOTION, MOTION]).to(dtype).expand(4, 3, 4, 4)
    instance = instance_map(4)
    riding_with_camera = (instance != 1).expand(4, 2, HEIGHT, WIDTH)
    raw, valid = rigid_flow(depth, instance, camera, rows)
    ego, ego_valid = ego_flow(depth, camera, MOTION.to(dtype))
    bits = torch.int32 if dtype == torch.float32 else torch.int64
    assert torch.equal(raw.view(bits)[riding_with_camera], ego.view(bits)[riding_with_camera])
    assert torch.equal(valid[instance != 1], ego_valid[instance != 1])
    assert not torch.equal(raw, ego)


def test_a_body_that_came_from_behind_is_invalid_alone():
    motions = torch.eye(4).repeat(2, 1, 1)
    motions[1, 2, 3] = -9.0  # body 1 was 9 m further back: behind the camera
    depth, instance = torch.full((1, 1, 2), 4.0), torch.tensor([[[1, 0]]])
    flow, valid = rigid_flow(depth, instance, K.float(), motions)
    assert valid.tolist() == [[[False, True]]]
    assert flow.abs().max() == 0


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32, torch.int64])
def test_ids_of_any_integer_type(dtype):
    expected = rigid_flow(depth_map(), instance_map(), K, MOTIONS).flow
    got = rigid_flow(depth_map(), instance_map(dtype=dtype), K, MOTIONS).flow
    assert torch.equal(got, expected)


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_any_batch_equals_a_loop(batch):
    generator = torch.Generator().manual_seed(5)
    noise = torch.rand((*batch, 3, 4, 4), generator=generator, dtype=torch.float64)
    Ks, motions = K + noise[..., 0, :3, :3], MOTIONS + 0.1 * noise
    depth, instance = depth_map(*batch), instance_map(*batch)
    flow, valid = rigid_flow(depth, instance, Ks, motions, dt=0.5)
    assert flow.shape == (*batch, 2, HEIGHT, WIDTH)
    assert valid.shape == (*batch, 1, HEIGHT, WIDTH)
    for at in product(*map(range, batch)):
        alone = rigid_flow(depth[at], instance[at], Ks[at], motions[at], dt=0.5)
        assert torch.equal(flow[at], alone.flow)
    unbatched_K = rigid_flow(depth, instance, K, motions).flow
    assert torch.equal(unbatched_K, rigid_flow(depth, instance, K.expand_as(Ks), motions).flow)


@pytest.mark.parametrize(("id_", "held"), [(-1, "-1 to 2"), (3, "0 to 3")])
def test_an_id_without_a_row_is_refused(id_, held):
    instance = instance_map(2, dtype=torch.int32)
    instance[1, 0, 2, 3] = id_
    with pytest.raises(RuntimeError, match=f"instance holds ids {held}.* 0 to 2; .*InstanceIds"):
        rigid_flow(depth_map(2), instance, K, MOTIONS)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda d, i: rigid_flow(d, i.float(), K, MOTIONS), TypeError, "instance must hold integ"),
        (lambda d, i: rigid_flow(d, i == 0, K, MOTIONS), TypeError, "integer ids, got torch.bool"),
        (lambda d, i: rigid_flow(d, i[0], K, MOTIONS), ValueError, r"instance must be \[\*B, 1, H"),
        (
            lambda d, i: rigid_flow(d, i.mT, K, MOTIONS),
            ValueError,
            r"instance and depth must have one \(height, width\), got \[7, 5\] and \[5, 7\]",
        ),
        (
            lambda d, i: rigid_flow(d, i, K, MOTION),
            ValueError,
            r"prev_from_curr_by_instance must be \[\*B, N, 4, 4\], got \[4, 4\]",
        ),
        (
            lambda d, i: rigid_flow(d, i.expand(2, -1, -1, -1), K, MOTIONS.expand(3, -1, -1, -1)),
            ValueError,
            "leading batch dims do not broadcast",
        ),
    ],
)
def test_mistakes_are_named(call, error, message):
    with pytest.raises(error, match=message):
        call(depth_map(), instance_map())
