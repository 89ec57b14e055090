"""Flow against pictures alone: where a pixel is said to come from, the frame before shows it."""

from dataclasses import replace

import pytest
import torch

from flowrep.geometry import ego_flow, factorize, rigid_flow, unproject
from flowrep.scenes import load_scene, scene_names

LEFT, RIGHT, NO_OP = 1, 2, 0
# A drive that keeps to the road and turns both ways.
ACTIONS = [LEFT, RIGHT, RIGHT, LEFT, NO_OP, RIGHT, LEFT, LEFT, RIGHT, NO_OP] * 3


def drive(make_street, actions, name="straight_road", speed=(1.2, 1.8)):
    """Yields what is seen, as tensors, in an episode in which someone walks close by."""
    scene = load_scene(name)
    # H and W differ, and the view is narrow, so that legs too are many pixels wide.
    camera = replace(scene.camera, height_px=150, width_px=200, fov_deg=30.0)
    env = make_street(replace(scene, camera=camera), speed=speed)
    observation, ended = env.reset(options={"episode_seed": 11})[0], False
    for action in [*actions, NO_OP]:
        observation["K"] = env.K
        yield {key: torch.from_numpy(value) for key, value in observation.items()}
        if ended:
            return
        observation, _, ended, *_ = env.step(action)


def centres(image):
    """Returns u and v of the pixels' centres."""
    v, u = (torch.arange(side) + 0.5 for side in image.shape[-2:])
    return torch.meshgrid(u, v, indexing="xy")


def came_from(frame):
    """Returns where pixels were (u, v) and their depth there, predicted from this frame alone."""
    depth, instance, K = frame["depth"], frame["instance"].long(), frame["K"]
    flow, valid = rigid_flow(depth, instance, K, frame["instance_motion"])
    u, v = centres(depth)
    motion = frame["instance_motion"][instance[0]]  # [H, W, 4, 4]
    points = unproject(depth, K.float())[..., None]
    z = (motion[..., 2:3, :3] @ points)[..., 0, 0] + motion[..., 2, 3]
    return u - flow[0], v - flow[1], torch.where(depth[0].isinf(), torch.inf, z), valid[0]


def look_up(frame, u, v):
    """Returns instance and depth at points between pixel centres, and where they are certain.

    Inverse depth is linear in the image on a plane, so that its bilinear value is exact there. A
    place is certain if the 4 × 4 pixels around show one instance, one class and one plane.
    """
    height, width = frame["depth"].shape[-2:]
    left, top = (u - 0.5).floor().long(), (v - 0.5).floor().long()
    inside = (left >= 1) & (left < width - 2) & (top >= 1) & (top < height - 2)
    left, top = left.clamp(1, width - 3), top.clamp(1, height - 3)
    a, b = u - 0.5 - left, v - 0.5 - top
    around = range(-1, 3)
    ids = 256 * frame["semantic"][0].long() + frame["instance"][0]
    one = torch.stack([ids[top + j, left + i] == ids[top, left] for j in around for i in around])
    inverse = 1.0 / frame["depth"][0].double()
    corner = [inverse[top + j, left + i] for j in (0, 1) for i in (0, 1)]
    upper, lower = (1 - a) * corner[0] + a * corner[1], (1 - a) * corner[2] + a * corner[3]
    value = (1 - b) * upper + b * lower
    bends = [
        inverse[y - dv, x - du] - 2 * inverse[y, x] + inverse[y + dv, x + du]
        for y in (top, top + 1)
        for x in (left, left + 1)
        for du, dv in ((1, 0), (0, 1))
    ]
    flat = torch.stack(bends).abs().amax(0) <= 2e-4 * value + 1e-12
    return frame["instance"][0][top, left], 1.0 / value, inside & one.all(0) & flat


def agreement(before, now):
    """Returns, of static and of walking pixels, how many agree and how many were asked."""
    u, v, z, valid = came_from(now)
    instance, depth, certain = look_up(before, u, v)
    own_certain = look_up(now, *centres(z))[2]
    occluded = depth < 0.98 * z
    asked = valid & certain & own_certain & ~occluded
    same_depth = (depth == z) | ((depth - z).abs() < 1e-3 * z)
    agrees = (instance == now["instance"][0]) & same_depth
    walks = now["instance"][0] > 0
    return [
        (int((agrees & asked & part).sum()), int((asked & part).sum()), int((valid & part).sum()))
        for part in (~walks, walks)
    ]


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", scene_names())
def test_each_pixel_is_found_where_its_flow_says_it_was(make_street, name):
    frames = list(drive(make_street, ACTIONS, name))
    pairs = zip(frames[::2], frames[1::2])
    for agree, asked, seen in sum(torch.tensor(agreement(*pair)) for pair in pairs):
        assert asked > 500
        assert asked / seen > 0.3  # what is certain is no mere remnant
        assert agree / asked >= 0.99


def flows(frame):
    instance, K = frame["instance"].long(), frame["K"]
    raw = rigid_flow(frame["depth"], instance, K, frame["instance_motion"]).flow
    return raw, factorize(raw, frame["depth"], K, frame["prev_from_curr"]).obj


def test_standing_people_have_no_object_flow(make_street):
    moved, seen = False, 0
    for frame in drive(make_street, ACTIONS[:20], speed=(0.0, 0.0)):
        raw, obj = flows(frame)
        assert not obj.any()
        moved |= bool(raw.any())
        seen += int((frame["instance"] > 0).sum())
    assert moved
    assert seen > 100


def test_motions_are_the_identity_at_reset(make_street):
    frame = next(drive(make_street, []))
    assert torch.equal(frame["prev_from_curr"], torch.eye(4))
    assert torch.equal(frame["instance_motion"], torch.eye(4).expand_as(frame["instance_motion"]))
    assert not ego_flow(frame["depth"], frame["K"], frame["prev_from_curr"]).flow.any()


def test_legs_have_a_motion_of_their_own(make_street):
    differ = 0
    for frame in drive(make_street, ACTIONS[:20]):
        obj = flows(frame)[1][0]
        instance = frame["instance"][0].long()
        for person in range(int(instance.max()) // 3):
            body, left, right = (obj[instance == 3 * person + part] for part in (1, 2, 3))
            if min(len(body), len(left), len(right)) > 60:
                means = torch.stack([left.mean(), right.mean()]) - body.mean()
                # One leg swings forwards while the other swings back.
                differ += bool((means.sign().prod() < 0) & (means.abs() > 0.05).all())
    assert differ > 3
