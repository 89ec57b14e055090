"""Raw flow split in ego and object flow: the laws that make the split mean something."""

import math
from itertools import product

import pytest
import torch

from flowrep.geometry import ego_flow, factorize, rigid_flow
from tests.geometry.scenes import HEIGHT, MOTION, OTHER_MOTION, WIDTH, K, depth_map

STILL = torch.eye(4, dtype=torch.float64)
NAN, INF = math.nan, math.inf


def raw_flow(*batch: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(6)
    return 5 * torch.randn((*batch, 2, HEIGHT, WIDTH), generator=generator, dtype=torch.float64)


def test_by_hand():
    # 0.5 m to the right at 4 m: ego (-0.5, 0). Raw (-0.5, 3): the object moved 3 px down by itself.
    # Added instead of subtracted, obj would be (-1, 3).
    camera = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    slide = torch.eye(4)
    slide[0, 3] = 0.5
    raw = torch.tensor([-0.5, 3.0]).reshape(2, 1, 1)
    ego, obj, valid = factorize(raw, torch.full((1, 1, 1), 4.0), camera, slide)
    assert ego.flatten().tolist() == [-0.5, 0.0]
    assert obj.flatten().tolist() == [0.0, 3.0]
    assert valid.all()


def test_ego_is_ego_flow_and_the_parts_add_up():
    raw, depth = raw_flow(), depth_map()
    ego, obj, valid = factorize(raw, depth, K, MOTION, dt=0.5)
    assert valid.all()
    assert torch.equal(ego, ego_flow(depth, K, MOTION, dt=0.5).flow)
    assert torch.equal(obj, raw - ego)


def test_still_camera_leaves_everything_to_the_objects():
    raw = raw_flow()
    ego, obj, _ = factorize(raw, depth_map(), K, STILL)
    assert ego.abs().max() == 0
    assert torch.equal(obj, raw)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_does_not_move_by_itself_has_exactly_no_object_flow(dtype):
    depth, camera = depth_map(2).to(dtype), K.to(dtype)
    depth[0, 0, 0, :2] = torch.tensor([INF, NAN])
    instance = torch.zeros_like(depth, dtype=torch.uint8)
    instance[..., 2:4, 3:6] = 1
    motions = torch.stack([MOTION, OTHER_MOTION]).to(dtype).expand(2, 2, 4, 4)
    raw, _ = rigid_flow(depth, instance, camera, motions)
    _, obj, _ = factorize(raw, depth, camera, motions[:, 0])
    static = (instance == 0).expand_as(obj)
    assert obj[static].abs().max() == 0
    assert obj[~static].abs().min() > 0


def test_unknown_pixels_have_no_object_flow_and_say_so():
    raw, depth = raw_flow(), depth_map()
    depth[0, 0, 0] = NAN
    raw[0, 1, 1] = NAN
    raw[1, 2, 2] = INF
    raw[:, 3, 3] = torch.tensor([INF, -INF])
    ego, obj, valid = factorize(raw, depth, K, MOTION)
    unknown = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    unknown[[0, 1, 2, 3], [0, 1, 2, 3]] = True
    assert torch.equal(~valid[0], unknown)
    assert obj[:, unknown].abs().max() == 0
    assert torch.equal(obj[:, ~unknown], (raw - ego)[:, ~unknown])
    # The camera's share needs no raw flow: only the pixel without depth lacks it.
    assert ego[:, 0, 0].abs().max() == 0
    assert ego[:, [1, 2, 3], [1, 2, 3]].abs().min() > 0


def test_unknown_flow_of_a_body_is_no_object_flow():
    # The camera slid 0.5 m right before 4 m: ego -0.5 px. What was behind it has no raw flow; its 0
    # taken as measured would make obj +0.5.
    camera = torch.tensor([[4.0, 0.0, 1.0], [0.0, 8.0, 1.0], [0.0, 0.0, 1.0]])
    motions = torch.eye(4).repeat(2, 1, 1)
    motions[:, 0, 3] = 0.5
    motions[1, 2, 3] = -5.0
    depth, instance = torch.full((1, 1, 2), 4.0), torch.tensor([[[0, 1]]])
    raw = rigid_flow(depth, instance, camera, motions)
    ego, obj, valid = factorize(raw, depth, camera, motions[0])
    assert raw.flow[0].tolist() == [[-0.5, 0.0]]
    assert ego[0].tolist() == [[-0.5, -0.5]]
    assert (obj == 0).all()
    assert valid.tolist() == [[[True, False]]]


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_any_batch_equals_a_loop(batch):
    generator = torch.Generator().manual_seed(7)
    noise = torch.rand((*batch, 4, 4), generator=generator, dtype=torch.float64)
    Ks, motions = K + noise[..., :3, :3], MOTION + 0.1 * noise
    raw, depth = raw_flow(*batch), depth_map(*batch)
    got = factorize(raw, depth, Ks, motions)
    assert [part.shape[-3] for part in got] == [2, 2, 1]
    for at in product(*map(range, batch)):
        for part, alone in zip(got, factorize(raw[at], depth[at], Ks[at], motions[at])):
            assert torch.equal(part[at], alone)
    unbatched_K = factorize(raw, depth, K, motions)
    for part, other in zip(unbatched_K, factorize(raw, depth, K.expand_as(Ks), motions)):
        assert torch.equal(part, other)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda r, d: factorize(r[:1], d, K, MOTION), ValueError, r"raw must be \[\*B, 2, H, W\]"),
        (lambda r, d: factorize(r.int(), d, K, MOTION), TypeError, "raw must be floating point"),
        (
            lambda r, d: factorize(r, d[..., :-1], K, MOTION),
            ValueError,
            r"raw and depth must have one \(height, width\), got \[5, 7\] and \[5, 6\]",
        ),
        (
            lambda r, d: factorize(r.expand(2, -1, -1, -1), d.expand(3, -1, -1, -1), K, MOTION),
            ValueError,
            r"do not broadcast: others \[3\], raw \[2\]",
        ),
    ],
)
def test_mistakes_are_named(call, error, message):
    with pytest.raises(error, match=message):
        call(raw_flow(), depth_map())
