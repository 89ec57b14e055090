"""Poses of any convention, the motions between them, and ids of any simulator as rows."""

import math
from functools import partial

import pytest
import torch

from flowrep import geometry as g
from tests.geometry.scenes import MOTION, OTHER_MOTION, assert_equals_a_loop, rigid

QUARTER_TURN = torch.pi / 2


@pytest.mark.parametrize("points", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("transform", [torch.float32, torch.float64])
def test_transform_points_by_hand(transform, points):
    # Seen along z at 3 m by a camera 10.25 m along x that looks along world x. The inverse rotation
    # would give (8.25, -3, 0.5).
    world_from_cam = torch.tensor([[0, 0, 1, 10.25], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    points_cam = torch.tensor([[0.5, 2.0, 3.0]], dtype=points)
    points_world = g.transform_points(world_from_cam.to(transform), points_cam)
    assert points_world.dtype == torch.promote_types(transform, points)
    assert points_world.tolist() == [[13.25, -0.5, -2.0]]


def test_relative_motion_by_hand():
    # Both cameras look along world y (their z); the current one stands 2 m further on.
    world_from_prev = rigid((-QUARTER_TURN, 0.0, 0.0), (5.0, 1.0, 0.0))
    world_from_curr = rigid((-QUARTER_TURN, 0.0, 0.0), (5.0, 3.0, 0.0))
    prev_from_curr = g.relative_motion(world_from_prev, world_from_curr)
    # What the current camera sees 0 m ahead was 2 m ahead. curr_from_prev would have -2.
    torch.testing.assert_close(prev_from_curr[:3, 3].tolist(), [0.0, 0.0, 2.0])
    torch.testing.assert_close(prev_from_curr[:3, :3], torch.eye(3))


def test_invert_rigid_by_hand():
    a_from_b = rigid((0.0, 0.0, QUARTER_TURN), (10.0, 20.0, 30.0))
    # About z by a quarter turn, x goes to y: b's x axis is a's y axis, and a's origin lies at
    # -(20, -10, 30) in b. -t alone: (-10, -20, -30).
    torch.testing.assert_close(g.invert_rigid(a_from_b)[:3, 3].tolist(), [-20.0, 10.0, -30.0])


def test_relative_motion_is_the_product_of_poses():
    expected = torch.linalg.inv(MOTION) @ OTHER_MOTION
    got = g.relative_motion(MOTION, OTHER_MOTION, dtype=torch.float64)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_any_batch_equals_a_loop(batch):
    generator = torch.Generator().manual_seed(2)
    noise = torch.rand((*batch, 4, 4), generator=generator, dtype=torch.float64)
    poses = MOTION.expand(*batch, 4, 4).clone()
    poses[..., :3, 3] += noise[..., :3, 3]
    points = torch.rand((*batch, 2, 5, 3), generator=generator, dtype=torch.float64)

    def functions(poses, points):
        relative = g.relative_motion(poses, OTHER_MOTION)
        return relative, g.invert_rigid(poses), g.transform_points(poses, points)

    relative, *_ = assert_equals_a_loop(functions, batch, poses, points, atol=1e-12)
    assert relative.shape == (*batch, 4, 4)


PREV, CURR = rigid((0.1, 0.2, 0.3), (400.0, -300.0, 1.2)), rigid((0.1, 0.25, 0.3), (400.8, -300, 1))
BODY_BEFORE = torch.stack([MOTION, OTHER_MOTION])
BODY_NOW = torch.stack([MOTION, rigid((0.4, 0.0, -0.1), (2.0, 3.0, 4.0))])


def test_a_point_on_a_body_goes_where_it_was():
    motions = g.instance_motion(PREV, CURR, BODY_BEFORE, BODY_NOW, dtype=torch.float64)
    point_body = torch.tensor([0.3, -0.2, 0.7], dtype=torch.float64)
    curr_from_body = g.invert_rigid(CURR) @ BODY_NOW[1]
    prev_from_body = g.invert_rigid(PREV) @ BODY_BEFORE[1]
    was = g.transform_points(motions[2], g.transform_points(curr_from_body, point_body))
    torch.testing.assert_close(was, g.transform_points(prev_from_body, point_body))


def test_a_body_that_stands_still_has_the_camera_s_motion_to_the_last_bit():
    far = BODY_NOW.clone()
    far[:, :3, 3] += 1000.0 / 3.0
    motions = g.instance_motion(PREV, CURR, far, far)
    assert motions.dtype == torch.float32
    assert torch.equal(motions, g.relative_motion(PREV, CURR).expand(3, 4, 4))
    no_bodies = g.instance_motion(PREV, CURR, far[:0], far[:0])
    assert torch.equal(no_bodies, g.relative_motion(PREV, CURR)[None])
    # In float64 no rounding hides that the bodies' rows went another way.
    exact = g.instance_motion(PREV, CURR, far, far, dtype=torch.float64)
    camera = g.relative_motion(PREV, CURR, dtype=torch.float64)
    assert torch.equal(exact, camera.expand(3, 4, 4))


def test_equal_poses_are_exactly_no_motion():
    # R R^T of this rotation is not the identity in floats.
    assert torch.equal(g.relative_motion(PREV, PREV), torch.eye(4))
    both = g.relative_motion(torch.stack([PREV, PREV]), torch.stack([PREV, CURR]))
    assert torch.equal(both[0], torch.eye(4))
    assert not torch.equal(both[1], torch.eye(4))


# A camera at (5, 6, 7) that looks along the world's x, with z up: right is -y, down is -z.
LOOKING_ALONG_X = torch.tensor(
    [[0.0, 0.0, 1.0, 5.0], [-1.0, 0.0, 0.0, 6.0], [0.0, -1.0, 0.0, 7.0], [0.0, 0.0, 0.0, 1.0]]
).double()
# The same camera's axes in the other conventions, a column each, written down by hand.
AXES = {
    "opencv": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],  # right, down, forward
    "opengl": [[0, 0, -1], [-1, 0, 0], [0, 1, 0]],  # right, up, backward
    "ned": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],  # forward, right, down
    "x_forward_z_up": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # forward, left, up
}


@pytest.mark.parametrize("axes", AXES)
def test_axes_of_one_and_the_same_camera(axes):
    pose = LOOKING_ALONG_X.clone()
    pose[:3, :3] = torch.tensor(AXES[axes]).double()
    assert torch.equal(g.adapt_pose(pose, axes=axes), LOOKING_ALONG_X)
    # and of world-to-camera matrices, which are given in those axes too
    extrinsics = g.invert_rigid(pose)
    assert torch.equal(
        g.adapt_pose(extrinsics, direction="world_to_camera", axes=axes), LOOKING_ALONG_X
    )


# A camera that went 2 m ahead, 1 m to the right and 0.5 m up, then turned to the right (sine 0.28,
# cosine 0.96) and upwards (0.6, 0.8). In the axes of the camera before, right, down and forward:
#   right (0.96, 0, -0.28), forward (0.8 * 0.28, -0.6, 0.8 * 0.96), down = forward x right.
# Below are the same three directions, and where it went, in each simulator's left-handed axes.
TURNED = torch.tensor(
    [[0.96, 0.168, 0.224, 1], [0, 0.8, -0.6, -0.5], [-0.28, 0.576, 0.768, 2], [0, 0, 0, 1]],
    dtype=torch.float64,
)
LEFT_HANDED = {
    # columns forward, right, up; rows the same
    "unreal": [[0.768, -0.28, -0.576, 2], [0.224, 0.96, -0.168, 1], [0.6, 0, 0.8, 0.5]],
    # columns right, up, forward; rows the same
    "unity": [[0.96, -0.168, 0.224, 1], [0, 0.8, 0.6, 0.5], [-0.28, -0.576, 0.768, 2]],
}


@pytest.mark.parametrize("axes", LEFT_HANDED)
def test_poses_of_a_left_handed_world_give_the_same_motion(axes):
    prev_from_curr = torch.tensor([*LEFT_HANDED[axes], [0, 0, 0, 1]], dtype=torch.float64)
    world_from_prev = rigid((0.4, -1.1, 0.7), (30.0, -20.0, 5.0))
    poses = [world_from_prev, world_from_prev @ prev_from_curr]
    before, now = g.adapt_pose(torch.stack(poses), axes=axes)
    torch.testing.assert_close(g.relative_motion(before, now, dtype=torch.float64), TURNED)
    g.check_rigid("pose", torch.stack([before, now]))  # right-handed
    extrinsics = g.invert_rigid(torch.stack(poses))
    before, now = g.adapt_pose(extrinsics, axes=axes, direction="world_to_camera")
    torch.testing.assert_close(g.relative_motion(before, now, dtype=torch.float64), TURNED)


def test_where_a_left_handed_world_s_camera_is_and_looks():
    # Both at 5 along the first axis, 6 along the second, 7 along the third. Unreal's after a
    # quarter turn to the right, from x to y: it looks along y, the picture's right is -x. In a
    # right-handed world whose y is left that is along -y, from (5, -6, 7).
    unreal = torch.tensor([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1.0]])
    expected = [[-1, 0, 0, 5], [0, 0, -1, -6], [0, -1, 0, 7], [0, 0, 0, 1]]
    assert g.adapt_pose(unreal, axes="unreal").tolist() == expected
    yaw = torch.tensor([5.0, 6.0, 7.0, QUARTER_TURN]).double()
    by_angle = g.adapt_pose(yaw, layout="xyz_yaw", axes="unreal")
    torch.testing.assert_close(by_angle, torch.tensor(expected).double())
    # Unity's unturned: right x, down -y, forward z, which is -z in a world whose z is backward.
    unity = torch.eye(4)
    unity[:3, 3] = torch.tensor([5.0, 6.0, 7.0])
    expected = [[1, 0, 0, 5], [0, -1, 0, 6], [0, 0, -1, -7], [0, 0, 0, 1]]
    assert g.adapt_pose(unity, axes="unity").tolist() == expected


def test_a_pose_without_its_last_row():
    whole = torch.tensor([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1.0]])
    assert g.adapt_pose(whole[:3], layout="matrix_3x4").equal(whole.double())
    apart = torch.cat([whole[:3, :3].flatten(), whole[:3, 3]])
    assert g.adapt_pose(apart, layout="rotation_xyz").equal(whole.double())
    inverted = g.adapt_pose(whole[:3], layout="matrix_3x4", direction="world_to_camera")
    torch.testing.assert_close(inverted @ whole.double(), torch.eye(4).double())


def test_angles_turn_left_and_look_up():
    adapt, half = partial(g.adapt_pose, axes="x_forward_z_up"), math.sqrt(3) / 2
    pose = torch.tensor([5.0, 6.0, 7.0, math.pi / 2, math.pi / 6], dtype=torch.float64)
    # A quarter turn to the left of x is y, and right is x. 30 degrees up: ahead rises by sin 30,
    # not -sin 30, and the picture's down leans ahead.
    expected = [[1, 0, 0, 5], [0, 0.5, half, 6], [0, -half, 0.5, 7], [0, 0, 0, 1]]
    camera = adapt(pose, layout="xyz_yaw_pitch")
    torch.testing.assert_close(camera, torch.tensor(expected).double())
    aslant = torch.tensor([5.0, 6.0, 7.0, math.pi / 3, math.pi / 6], dtype=torch.float64)
    # down is the up of (-cos 60 sin 30, -sin 60 sin 30, cos 30), turned over
    expected = torch.tensor([0.25, half / 2, -half], dtype=torch.float64)
    torch.testing.assert_close(adapt(aslant, layout="xyz_yaw_pitch")[:3, 1], expected)
    level = adapt(pose[:4], layout="xyz_yaw")
    torch.testing.assert_close(level[:3, 2], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


TURNS = ("xyz_xyzw", "xyz_wxyz", "xyzw_xyz", "wxyz_xyz", "xyz_rotvec", "rotvec_xyz")


@pytest.mark.parametrize("layout", TURNS)
@pytest.mark.parametrize(("axis", "moves", "to"), [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_a_quarter_turn_about_each_axis(axis, moves, to, layout):
    # cos 45 and sin 45 degrees about the axis. About z, xyzw read as wxyz would turn about y.
    turn = [0.0, 0.0, 0.0]
    turn[axis] = math.pi / 2 if "rotvec" in layout else math.sqrt(0.5)
    if "xyzw" in layout:
        turn = [*turn, math.sqrt(0.5)]
    elif "wxyz" in layout:
        turn = [math.sqrt(0.5), *turn]
    place = [1.0, 2.0, 3.0]
    pose = torch.tensor([*place, *turn] if layout.startswith("xyz_") else [*turn, *place])
    matrix = g.adapt_pose(pose, layout=layout)
    unit = torch.eye(4).double()
    torch.testing.assert_close(matrix @ unit[moves], unit[to], atol=1e-6, rtol=0)
    assert matrix[:, 3].tolist() == [1.0, 2.0, 3.0, 1.0]
    assert matrix[3].tolist() == [0.0, 0.0, 0.0, 1.0]


POSE = rigid((0.3, -0.2, 0.9), (5.0, 6.0, 7.0))


@pytest.mark.parametrize(
    ("pose", "expected"),
    [
        (POSE * math.nan, ".*nan"),
        (POSE.mT, r".*\(0, 0, 0, 1\)"),
        (POSE @ torch.diag(torch.tensor([1.01, 1.01, 1.01, 1.0])).double(), ".*rigid"),
        (POSE @ torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0])).double(), ".*left-handed"),
    ],
)
def test_an_ill_formed_pose_is_refused_by_name_and_place(pose, expected):
    poses = torch.eye(4).double().repeat(2, 3, 1, 1)
    poses[1, 2] = pose
    with pytest.raises(ValueError, match=rf"^pose\[1, 2\]{expected}"):
        g.adapt_pose(poses)
    assert g.adapt_pose(poses, check=False).shape == (2, 3, 4, 4)


def test_a_quaternion_that_is_not_of_unit_length_is_refused():
    pose = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    with pytest.raises(ValueError, match=r"quaternion.*\[2.0\]"):
        g.adapt_pose(pose, layout="xyz_xyzw")
    normalised = g.adapt_pose(pose, layout="xyz_xyzw", check=False)
    assert torch.equal(normalised, torch.eye(4).double())


def test_ids_of_any_simulator_become_rows():
    ids = torch.tensor([[[17, 0, 3], [-1, 4, 16_777_215]]])
    rows = g.instance_rows(ids, torch.tensor([17, 3, 16_777_215]))
    # A static world of id 0, a background of -1 and the unknown body 4 are row 0.
    assert rows.tolist() == [[[1, 0, 2], [0, 0, 3]]]
    assert rows.dtype == torch.uint8
    assert g.instance_rows(ids, torch.arange(400)).dtype == torch.int32
    assert g.instance_rows(ids, torch.arange(0)).tolist() == [[[0, 0, 0], [0, 0, 0]]]
    assert g.instance_rows(ids.short()[..., :1].mT, torch.tensor([17])).tolist() == [[[1, 0]]]
