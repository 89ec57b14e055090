"""PyBullet cameras against PyBullet itself: its kinematics, and the pictures of the step before.

What is expected is computed here from `getCameraImage`'s buffers, the projection matrix and
`getLinkState`, none of which flowrep's code is asked for.
"""

import importlib.util
import inspect
import math
import os

import gymnasium as gym
import numpy as np
import pybullet
import pybullet_data
import pytest
import torch
from pybullet_utils.bullet_client import BulletClient
from tensordict import TensorDict
from torchrl.envs import Compose, GymWrapper, TransformedEnv, check_env_specs

from flowrep.geometry import rigid_flow
from flowrep.pybullet import BulletCamera, BulletFlow
from flowrep.transforms import FlowFactorize, RawFlow
from tests.running import run_python

HEIGHT, WIDTH = 90, 132
VIEW = pybullet.computeViewMatrix([1.1, -0.9, 0.8], [0.1, 0, 0.3], [0, 0, 1])
PLANE, SKY = 0, -1


@pytest.fixture
def world():
    """A world with a plane, body 0, and gravity."""
    client = BulletClient(pybullet.DIRECT)
    client.setAdditionalSearchPath(pybullet_data.getDataPath())
    assert client.loadURDF("plane.urdf") == PLANE
    client.setGravity(0, 0, -9.8)
    yield client
    client.disconnect()


def box(client, position, half=(0.1, 0.08, 0.06), mass=0.0, **more):
    shape = {"halfExtents": half}
    solid = client.createCollisionShape(pybullet.GEOM_BOX, **shape)
    seen = client.createVisualShape(pybullet.GEOM_BOX, **shape)
    return client.createMultiBody(mass, solid, seen, position, **more)


def matrix(position, quaternion):
    pose = np.eye(4)
    pose[:3, :3] = np.reshape(pybullet.getMatrixFromQuaternion(quaternion), (3, 3))
    pose[:3, 3] = position
    return pose


def column_major(numbers):
    return np.reshape(numbers, (4, 4)).T


def pose_of(client, body, link):
    """The pose of a base, or of a link as Bullet's own kinematics have it."""
    if link < 0:
        return matrix(*client.getBasePositionAndOrientation(body))
    return matrix(*client.getLinkState(body, link, computeForwardKinematics=1)[:2])


# What is drawn


def z_and_ids(client, view, projection, size):
    """Depth and packed ids of PyBullet's picture: 2 zb - 1 = P23 / z - P22."""
    height, width = size
    flags = pybullet.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX
    _, _, _, buffer, ids = client.getCameraImage(width, height, view, projection, flags=flags)
    ids = np.reshape(ids, size)
    p = column_major(projection)
    z = p[2, 3] / (p[2, 2] - 1 + 2 * np.reshape(buffer, size).astype(float))
    return np.where(ids == SKY, np.inf, z), ids


def heights(depth, K, view):
    """World z of every pixel, unprojected by K."""
    v, u = np.indices(depth.shape) + 0.5
    depth = np.where(np.isfinite(depth), depth, 1e9)
    x, y = (u - K[0, 2]) / K[0, 0] * depth, (v - K[1, 2]) / K[1, 1] * depth
    points_gl = np.stack([x, -y, -depth, np.ones_like(x)], -1)
    return (points_gl @ np.linalg.inv(column_major(view)).T)[..., 2]


@pytest.mark.parametrize(
    "camera",
    [
        {"fov_deg": 60.0},
        {"fov_deg": 40.0, "near_m": 0.2, "far_m": 1000.0},
        {"fov_deg": 75.0, "near_m": 0.02, "far_m": 3.0},
        {"projection": pybullet.computeProjectionMatrix(-0.07, 0.03, -0.02, 0.05, 0.1, 20.0)},
    ],
)
def test_a_floor_seen_through_k_is_flat(world, camera):
    rolled = pybullet.computeViewMatrix([0, -1, 0.9], [0.2, 0.3, 0], [0.3, 0.1, 1])
    camera = BulletCamera(world, WIDTH, HEIGHT, view=rolled, **camera)
    depth = camera.reset()["depth"][0]
    near = (depth > 0) & (depth < 2.5)
    assert near.sum() > 2000
    assert abs(heights(depth, camera.K, rolled)[near]).max() < 1e-4
    for shift in ((0.5, 0), (-0.5, 0.5), (0, -0.5)):  # (-0.5, 0.5) samples at the pixel's centre
        K = camera.K.copy()
        K[:2, 2] += shift
        assert abs(heights(depth, K, rolled)[near]).max() > 1e-3


def test_where_nothing_was_drawn_depth_is_inf_though_the_buffer_is_not_1(world):
    up = pybullet.computeViewMatrix([0, 0, 1], [0, 1, 1.2], [0, 0, 1])
    for near_m, far_m in ((0.1, 20.0), (0.02, 20.0), (0.1, 100.0), (1.0, 3.0)):
        camera = BulletCamera(world, 60, 40, fov_deg=60, near_m=near_m, far_m=far_m, view=up)
        seen = camera.reset()
        assert np.isinf(seen["depth"][0, :20]).all()
        assert (seen["instance"][0, :20] == 0).all()


def test_rgb_and_semantic_maps_show_the_bodies(world):
    crate = box(world, [0, 0, 0.06])
    options = {"fov_deg": 60, "view": VIEW}
    plain = BulletCamera(world, 60, 40, **options)
    full = BulletCamera(world, 60, 40, rgb=True, classes={crate: 3, PLANE: 1, 9: 2}, **options)
    assert set(plain.reset()) == {"depth", "instance", "prev_from_curr", "instance_motion"}
    seen = full.reset()
    assert seen["rgb"].shape == (3, 40, 60)
    assert seen["rgb"].dtype == np.uint8
    for body, class_id in ((crate, 3), (PLANE, 1)):
        pixels = seen["instance"] == full.rows[body, -1]
        assert pixels.sum() > 10
        assert (seen["semantic"][pixels] == class_id).all()
    assert (seen["semantic"][seen["instance"] == 0] == 0).all()
    assert full.space().contains(seen)
    _, _, rgba, *_ = world.getCameraImage(60, 40, VIEW, full._picture["projectionMatrix"], shadow=0)
    assert (seen["rgb"] == np.reshape(rgba, (40, 60, 4))[..., :3].transpose(2, 0, 1)).all()


# How it moves

ROBOTS = {
    "franka_panda/panda.urdf": {0, 1, 4},  # turned and sliding joints, and fixed ones
    "humanoid/humanoid.urdf": {0, 2, 4},  # spherical joints
    "mjcf/humanoid_symmetric.xml": {0, 4},  # axes of another length than 1
    "racecar/racecar.urdf": {0, 4},
}


@pytest.mark.parametrize("name", ROBOTS)
def test_links_move_as_bullets_own_kinematics_say(world, name):
    load = world.loadMJCF if name.endswith("xml") else world.loadURDF
    robot = load(os.path.join(pybullet_data.getDataPath(), name))
    robot = robot if isinstance(robot, int) else robot[0]
    start = pybullet.getQuaternionFromEuler([0.3, 0.2, 0.1])
    world.resetBasePositionAndOrientation(robot, [0.1, 0.2, 1.5], start)
    random, links = np.random.default_rng(0), range(world.getNumJoints(robot))
    assert {world.getJointInfo(robot, link)[2] for link in links} == ROBOTS[name]
    for link in links:
        kind = world.getJointInfo(robot, link)[2]
        if kind in (pybullet.JOINT_REVOLUTE, pybullet.JOINT_PRISMATIC):
            world.resetJointState(robot, link, random.uniform(-0.5, 0.5), random.uniform(-3, 3))
        elif kind == pybullet.JOINT_SPHERICAL:
            turn = pybullet.getQuaternionFromEuler(random.uniform(-1, 1, 3))
            world.resetJointStateMultiDof(robot, link, turn, random.uniform(-2, 2, 3).tolist())
    camera = BulletCamera(world, 8, 6, fov_deg=60, view=VIEW)
    camera.reset()
    before = [pose_of(world, robot, link) for link in (-1, *links)]
    for _ in range(4):
        world.stepSimulation()
    rows = camera()["instance_motion"]
    gl_from_world = column_major(VIEW)
    cam_from_world = np.diag([1, -1, -1, 1]) @ gl_from_world
    world_from_cam = np.linalg.inv(cam_from_world)
    for link, old in zip((-1, *links), before):
        new = pose_of(world, robot, link)
        expected = cam_from_world @ old @ np.linalg.inv(new) @ world_from_cam
        np.testing.assert_allclose(rows[camera.rows[robot, link]], expected, atol=2e-6)
        assert abs(expected - np.eye(4)).max() > 1e-3


def flow_of(seen, K):
    """Raw flow [2, H, W] and where it is known, as `RawFlow` computes it."""
    maps = [torch.from_numpy(seen[name]) for name in ("depth", "instance", "instance_motion")]
    raw, known = rigid_flow(*maps[:2], torch.as_tensor(K), maps[2])
    return raw.numpy(), known[0].numpy()


class Record:
    """A picture and the poses in it, taken apart from flowrep's camera."""

    def __init__(self, client, view, projection):
        self.view, self.projection = view, projection
        self.z, self.ids = z_and_ids(client, view, projection, (HEIGHT, WIDTH))
        packed = [int(each) for each in np.unique(self.ids) if each != SKY]
        self.poses = {each: pose_of(client, each & 0xFFFFFF, (each >> 24) - 1) for each in packed}


def contradicted(before, now, raw, known):
    """Counts of pixels: where the frame before shows something else, that it shows, and of all.

    A pixel is hidden in the frame before where something nearer stands next to where it was.
    """
    p = column_major(now.projection)
    fx, fy = p[0, 0] * WIDTH / 2, p[1, 1] * HEIGHT / 2
    v, u = np.indices(now.z.shape) + 0.5
    seen = np.where(now.ids == SKY, 1.0, now.z)
    # the software renderer's pixel (i, j) is sampled at u = i, v = j + 1
    x, y = (u - 0.5 - WIDTH / 2) / fx * seen, (v + 0.5 - HEIGHT / 2) / fy * seen
    points_gl = np.stack([x, -y, -seen, np.ones_like(x)], -1)
    expected = np.full(now.z.shape, np.nan)
    for each in now.poses.keys() & before.poses.keys():
        world_from_gl = np.linalg.inv(column_major(now.view))
        carried = before.poses[each] @ np.linalg.inv(now.poses[each]) @ world_from_gl
        on_it = now.ids == each
        expected[on_it] = -((column_major(before.view) @ carried)[2] * points_gl[on_it]).sum(-1)
    asked = known & np.isfinite(expected)
    left, top = (
        np.floor(np.where(asked, c, 0) - 0.5).astype(int) for c in (u - raw[0], v - raw[1])
    )
    asked &= (left >= 0) & (left < WIDTH - 1) & (top >= 0) & (top < HEIGHT - 1)
    left, top = left.clip(0, WIDTH - 2), top.clip(0, HEIGHT - 2)
    around = [(top + down, left + right) for down in (0, 1) for right in (0, 1)]
    a, b = u - raw[0] - 0.5 - left, v - raw[1] - 0.5 - top
    shares = (1 - b) * (1 - a), (1 - b) * a, b * (1 - a), b * a
    # inverse depth is linear in the picture of a plane
    between = sum(share / before.z[place] for share, place in zip(shares, around))
    same = np.stack([before.ids[place] == now.ids for place in around])
    ratios = np.stack([before.z[place] / expected for place in around])
    agrees = same.all(0) & (abs(between * expected - 1) < 0.005)
    agrees |= (same & (abs(ratios - 1) < 0.02)).any(0)  # next to an edge, a neighbour will do
    visible = agrees | (ratios > 0.99).all(0)
    return np.array([(asked & visible & ~agrees).sum(), (asked & visible).sum(), asked.sum()])


def check_drive(client, camera, views, steps):
    """Compares every frame of a drive with the one before it."""
    total, before, moved = np.zeros(3), None, 0.0
    for t, (view, step) in enumerate(zip(views, steps)):
        step()
        view = view()
        now = Record(client, view, camera._picture["projectionMatrix"])
        seen = camera(view) if t else camera.reset(view)
        raw, known = flow_of(seen, camera.K)
        if before is not None:
            total += contradicted(before, now, raw, known)
            moved = max(moved, abs(raw).max())
        before = now
    wrong, visible, asked = total
    assert wrong / visible < 0.01
    assert visible / asked > 0.9
    assert asked > 1000 * len(views)
    assert moved > 3


def test_flow_of_links_and_a_moving_camera_agrees_with_the_pictures(world):
    robot = world.loadURDF("kuka_iiwa/model.urdf", useFixedBase=True)
    crate = box(world, [0.5, 0.3, 0.4], mass=1.0)
    world.resetBaseVelocity(crate, [-0.5, 0, 1], [0, 3, 5])

    def step():
        for link in range(world.getNumJoints(robot)):
            turn = {"targetVelocity": 1.5 - link, "force": 500}
            world.setJointMotorControl2(robot, link, pybullet.VELOCITY_CONTROL, **turn)
        for _ in range(10):
            world.stepSimulation()

    def view(t):
        eye = [1.1 - 0.04 * t, -0.9, 0.8 + 0.02 * t]
        return pybullet.computeViewMatrix(eye, [0.1, 0.02 * t, 0.4], [0.1, 0, 1])

    camera = BulletCamera(world, WIDTH, HEIGHT, fov_deg=60)
    check_drive(world, camera, [lambda t=t: view(t) for t in range(10)], [step] * 10)


def test_flow_of_a_camera_on_a_link_agrees_with_the_pictures(world):
    robot = world.loadURDF("kuka_iiwa/model.urdf", useFixedBase=True)
    box(world, [0.5, 0.1, 0.06])
    world.resetJointState(robot, 3, -1.5)
    mount = pybullet.computeViewMatrix([0.1, 0.0, 0.05], [0.15, 0.0, 1.0], [1, 0, 0])

    def view():
        """The link's frame, as PyBullet reports it, with the mount's view in it."""
        world_from_link = matrix(*world.getLinkState(robot, 6, computeForwardKinematics=1)[4:6])
        return (column_major(mount) @ np.linalg.inv(world_from_link)).T.ravel().tolist()

    def step():
        for link in (0, 1, 3, 5):
            turn = {"targetVelocity": 0.8, "force": 500}
            world.setJointMotorControl2(robot, link, pybullet.VELOCITY_CONTROL, **turn)
        for _ in range(8):
            world.stepSimulation()

    class Riding(BulletCamera):
        def __call__(self, view=None):
            return super().__call__()

    options = {"fov_deg": 70, "view": mount, "link": (robot, 6)}
    camera = Riding(world, WIDTH, HEIGHT, **options)
    check_drive(world, camera, [view] * 8, [step] * 8)
    own = camera()  # its own link stands still in the picture
    assert np.array_equal(own["prev_from_curr"], np.eye(4))


def test_a_link_s_axes_are_those_of_the_urdf_with_z_ahead(world):
    """The robot's tool looks down; the base's inertia lies 7 cm above its link."""
    robot = world.loadURDF("kuka_iiwa/model.urdf", [0.2, 0.3, 1], useFixedBase=True)
    ahead = BulletCamera(world, 41, 31, fov_deg=60, link=(robot, -1), near_m=2.5)
    turned = pybullet.getQuaternionFromEuler([math.pi, 0, 0])  # z points down
    world.resetBasePositionAndOrientation(robot, *pybullet.multiplyTransforms(
        [0.2, 0.3, 3.0], turned, *world.getDynamicsInfo(robot, -1)[3:5]
    ))  # fmt: skip
    world.removeBody(box(world, [0, 0, 9]))
    depth = ahead.reset()["depth"][0]
    assert np.isfinite(depth).all()
    np.testing.assert_allclose(depth, 3.0, atol=1e-4)


def test_flow_of_bodies_that_appear_and_vanish_agrees_with_the_pictures(world):
    bodies = [box(world, [0.3, 0.2, 0.1]), box(world, [0.0, -0.3, 0.2])]
    times = iter(range(10))

    def step():
        t = next(times)
        for i, body in enumerate(bodies):
            turn = pybullet.getQuaternionFromEuler([0, 0.1 * t, 0.2 * t])
            place = [0.3 - 0.3 * i + 0.03 * t, 0.2 - 0.5 * i, 0.2]
            world.resetBasePositionAndOrientation(body, place, turn)
        if t in (2, 6):
            bodies.append(box(world, [-0.2, 0.25, 0.3]))
        if t in (4, 5):
            world.removeBody(bodies.pop(0))

    camera = BulletCamera(world, WIDTH, HEIGHT, fov_deg=50)
    check_drive(world, camera, [lambda: VIEW] * 10, [step] * 10)


def test_bodies_at_rest_have_exactly_no_object_flow_before_a_moving_camera(world):
    robot = world.loadURDF("kuka_iiwa/model.urdf", useFixedBase=True)
    box(world, [0.5, 0.3, 0.1])
    camera = BulletCamera(world, WIDTH, HEIGHT, fov_deg=60)
    camera.reset(VIEW)
    world.resetJointState(robot, 3, 0.2)
    moved = pybullet.computeViewMatrix([1.05, -0.95, 0.8], [0.1, 0.01, 0.3], [0, 0, 1])
    td = TensorDict(sensor=camera(moved))
    td = Compose(RawFlow(camera.K), FlowFactorize(camera.K))(td)
    hand = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    for link in (3, 4, 5, 6):
        hand |= td["sensor", "instance"] == camera.rows[robot, link]
    assert hand.sum() > 50
    assert td["raw"].abs().max() > 5
    assert (td["obj"][(~hand).expand(2, -1, -1)] == 0).all()
    assert (td["obj"].norm(dim=0)[hand[0]] > 0).float().mean() > 0.9


def test_at_a_reset_motions_are_the_identity(world):
    crate = box(world, [0.3, 0.2, 0.1])
    camera = BulletCamera(world, 60, 40, fov_deg=60)
    camera.reset(VIEW)
    world.resetBasePositionAndOrientation(crate, [0, 0, 0.3], [0, 0, 0, 1])
    other = pybullet.computeViewMatrix([0.9, -0.9, 0.8], [0, 0, 0.3], [0, 0, 1])
    seen = camera.reset(other)
    assert np.array_equal(seen["instance_motion"], np.tile(np.eye(4), (65, 1, 1)))
    assert np.array_equal(seen["prev_from_curr"], np.eye(4))


# Which body is which


def test_the_motion_of_a_new_body_is_unknown_for_one_step(world):
    camera = BulletCamera(world, 60, 40, fov_deg=60, view=VIEW)
    camera.reset()
    crate = box(world, [0.1, 0, 0.3])
    seen = camera()
    row = camera.rows[crate, -1]
    assert np.isnan(seen["instance_motion"][row]).any()
    assert not flow_of(seen, camera.K)[1][seen["instance"][0] == row].any()
    world.resetBasePositionAndOrientation(crate, [0.1, 0, 0.4], [0, 0, 0, 1])
    seen = camera()
    raw, known = flow_of(seen, camera.K)
    here = seen["instance"][0] == camera.rows[crate, -1]
    assert camera.rows[crate, -1] == row
    assert known[here].all()
    assert abs(raw[1, here]).min() > 1


def test_a_body_with_the_number_of_a_removed_one_gets_another_row(world):
    crate = box(world, [0.1, 0, 0.3])
    camera = BulletCamera(world, 60, 40, fov_deg=60, view=VIEW)
    camera.reset()
    row = camera.rows[crate, -1]
    world.removeBody(crate)
    assert box(world, [0.2, 0.1, 0.3]) == crate  # PyBullet uses numbers again
    seen = camera()
    assert camera.rows[crate, -1] != row  # in both frames, a row is of one body
    assert np.isnan(seen["instance_motion"][camera.rows[crate, -1]]).any()
    assert np.isfinite(seen["instance_motion"][row]).all()


def test_rows_of_removed_bodies_are_reused_and_too_few_rows_are_refused(world):
    camera = BulletCamera(world, 60, 40, fov_deg=60, view=VIEW, max_instances=3)
    crates = [box(world, [0, 0, 0.3]), box(world, [0, 0.3, 0.3])]
    assert camera.reset()["instance_motion"].shape == (4, 4, 4)
    for _ in range(3):
        row = camera.rows[crates[0], -1]
        world.removeBody(crates.pop(0))
        camera()
        crates.append(box(world, [0.2, 0, 0.3]))
        camera()
        assert camera.rows[crates[-1], -1] == row
    box(world, [0.4, 0, 0.3])
    with pytest.raises(ValueError, match="max_instances=4"):
        camera()


def test_two_cameras_and_two_clients_at_once_do_not_mix(world):
    other = pybullet.connect(pybullet.DIRECT)
    try:
        ball = pybullet.createVisualShape(pybullet.GEOM_SPHERE, 0.2, physicsClientId=other)
        ball = pybullet.createMultiBody(0, -1, ball, [0, 0, 0.3], physicsClientId=other)
        crate = box(world, [0, 0, 0.3])
        first, second = (BulletCamera(world, 60, 40, fov_deg=60, view=VIEW) for _ in range(2))
        third = BulletCamera(other, 60, 40, fov_deg=60, view=VIEW)
        for camera in (first, second, third):
            camera.reset()
        world.resetBasePositionAndOrientation(crate, [0.1, 0, 0.3], [0, 0, 0, 1])
        moved = first()["instance_motion"][first.rows[crate, -1]]
        assert not np.array_equal(moved, np.eye(4))
        world.resetBasePositionAndOrientation(crate, [0.2, 0, 0.3], [0, 0, 0, 1])
        twice = second()["instance_motion"][second.rows[crate, -1]]  # since its own last call
        np.testing.assert_allclose(twice[:3, 3], 2 * moved[:3, 3], atol=1e-6)
        seen = third()
        assert np.array_equal(seen["instance_motion"], np.tile(np.eye(4), (65, 1, 1)))
        assert set(third.rows) == {(ball, -1)}
        assert set(np.unique(seen["instance"])) == {0, 1}
    finally:
        pybullet.disconnect(other)


def test_one_row_a_body_only_where_no_joint_moves(world):
    crate = box(world, [0, 0, 0.3])
    options = {"fov_deg": 60, "view": VIEW, "instances": "bodies"}
    camera = BulletCamera(world, 60, 40, **options)
    assert set(np.unique(camera.reset()["instance"])) == {0, 1, camera.rows[crate, -1]}
    world.loadURDF("kuka_iiwa/model.urdf")
    with pytest.raises(ValueError, match=r"lbr_iiwa.*instances='links'"):
        camera()


def test_links_that_pybullet_hides_are_refused(world):
    ball = world.createVisualShape(pybullet.GEOM_SPHERE, 0.1)
    ball = world.createMultiBody(1.0, -1, ball, [0, 0, 0.3], useMaximalCoordinates=True)
    camera = BulletCamera(world, 60, 40, fov_deg=60, view=VIEW)
    assert (camera.reset()["instance"] == camera.rows[ball, -1]).sum() > 10
    world.loadURDF("r2d2.urdf", [0, 0, 0.5], useMaximalCoordinates=True)
    with pytest.raises(ValueError, match=r"body 2.*useMaximalCoordinates"):
        camera()


def test_a_body_in_the_picture_that_the_client_does_not_list_is_named(world):
    class Unsynchronised:
        """A client to whose server another process has added a body."""

        def __getattr__(self, name):
            return getattr(world, name)

        def getNumBodies(self):
            return world.getNumBodies() - 1

    box(world, [0, 0, 0.3])
    with pytest.raises(RuntimeError, match=r"\[1\].*syncBodyInfo"):
        BulletCamera(Unsynchronised(), 60, 40, fov_deg=60, view=VIEW).reset()


def test_the_flow_of_soft_bodies_is_unknown(world):
    world.resetSimulation(pybullet.RESET_USE_DEFORMABLE_WORLD)
    cloth = world.loadSoftBody(
        "cloth_z_up.obj", basePosition=[0, 0, 0.4], scale=0.3, mass=1.0,
        useMassSpring=1, springElasticStiffness=40, useNeoHookean=0,
    )  # fmt: skip
    camera = BulletCamera(world, 60, 40, fov_deg=60, view=VIEW)
    camera.reset()
    for _ in range(3):
        world.stepSimulation()
    seen = camera()
    here = seen["instance"][0] == camera.rows[cloth, -1]
    assert here.sum() > 20
    assert not flow_of(seen, camera.K)[1][here].any()


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({}, "fov_deg.*projection"),
        ({"fov_deg": 60, "projection": list(range(16))}, "not both"),
        ({"near_m": 0.1, "projection": list(range(16))}, "not both"),
        ({"projection": [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]}, "perspective"),
        ({"fov_deg": 180}, "fov_deg"),
        ({"fov_deg": 60, "near_m": 2, "far_m": 1}, "near_m"),
        ({"fov_deg": 60, "instances": "joints"}, "instances"),
        ({"fov_deg": 60, "max_instances": 0}, "max_instances"),
        ({"fov_deg": 60, "view": None}, "view"),
        ({"fov_deg": 60, "view": [1.0] * 15}, "16"),
        ({"fov_deg": 60, "view": [2.0] * 16}, "rotation"),
        ({"fov_deg": 60, "link": (0, 3)}, r"link 3.*0: '0 links'"),
        ({"fov_deg": 60, "link": (7, -1)}, "body 7"),
    ],
)
def test_invalid_arguments_are_refused_by_name(world, options, names):
    with pytest.raises(ValueError, match=names):
        BulletCamera(world, 60, 40, **{"view": VIEW, **options}).reset()


# Envs of others


def panda():
    pytest.importorskip("panda_gym", reason="an env that others wrote: pip install panda-gym")
    return gym.make("PandaPush-v3")


def bullet_env(name):
    reason = "envs that others wrote: pip install pybullet-envs-gymnasium"
    pytest.importorskip("pybullet_envs_gymnasium", reason=reason)
    return gym.make(name)


def on_hand(env):
    robot = env.sim._bodies_idx["panda"]
    return BulletCamera(
        env.sim.physics_client, WIDTH, HEIGHT, fov_deg=80, link=(robot, env.robot.ee_link)
    )


def chasing(env):
    def view():
        x, y, z = env.robot.body_xyz
        eye, up = [x + 1.5, y + 1.5, z + 0.7], [0, 0, 1]
        return pybullet.computeViewMatrix(eye, [x, y, z], up)

    return BulletCamera(env._p, WIDTH, HEIGHT, fov_deg=60, view=view)


# Each with the number of a body that stands.
ENVS = {
    "panda, hand": (panda, on_hand, 2),
    "ant, chased": (lambda: bullet_env("AntBulletEnv-v0"), chasing, 0),
}


def hand_view(env):
    camera = env.unwrapped
    robot, link = camera.sim._bodies_idx["panda"], camera.robot.ee_link
    frame = camera.sim.physics_client.getLinkState(robot, link, computeForwardKinematics=1)[4:6]
    gl_from_world = np.diag([1, -1, -1, 1]) @ np.linalg.inv(matrix(*frame))
    return gl_from_world.T.ravel().tolist()


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", ENVS)
def test_flow_in_others_envs_agrees_with_the_pictures(name):
    make, camera, _ = ENVS[name]
    env = BulletFlow(make(), camera)
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    total, before = np.zeros(3), None
    for _ in range(8):
        view = hand_view(env) if camera is on_hand else env.camera._view
        view = view() if callable(view) else view
        now = Record(env.camera._client, view, env.camera._picture["projectionMatrix"])
        raw, known = flow_of(observation["sensor"], env.K)
        if before is not None:
            total += contradicted(before, now, raw, known)
        before = now
        observation, *_ = env.step(env.action_space.sample())
    wrong, visible, asked = total
    assert wrong / visible < 0.01
    assert visible / asked > 0.9
    assert asked > 20_000
    env.close()


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", ENVS)
def test_a_camera_does_not_change_the_env(name):
    make, camera, _ = ENVS[name]

    def drive(env):
        env.action_space.seed(0)
        env.reset()
        observations = [env.reset(seed=0)[0]]
        observations += [env.step(env.action_space.sample())[0] for _ in range(10)]
        env.close()
        return [each["observation"] if isinstance(each, dict) else each for each in observations]

    plain = make()
    plain.reset()  # as BulletFlow does
    assert np.array_equal(drive(BulletFlow(make(), camera)), drive(plain))


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", ENVS)
def test_envs_become_torchrl_envs_with_flow(name):
    make, camera, stands = ENVS[name]
    wrapped = BulletFlow(make(), camera)
    outside = gym.wrappers.TimeLimit(wrapped, 5)
    K = outside.get_wrapper_attr("K")
    env = TransformedEnv(GymWrapper(outside), Compose(RawFlow(K), FlowFactorize(K)))
    check_env_specs(env, seed=0)
    env.set_seed(0)
    frames = env.rollout(12, break_when_any_done=False)
    done = frames["next", "done"].flatten()
    assert done[:-1].any()
    assert (frames["raw"][1:][done[:-1]] == 0).all()  # the frames after a reset
    assert (frames["raw"] != 0).any()
    torch.testing.assert_close(frames["raw"], frames["ego"] + frames["obj"])
    still = frames["sensor", "instance"] == wrapped.camera.rows[stands, -1]
    assert still.any()
    assert (frames["obj"][still.expand_as(frames["obj"])] == 0).all()
    env.close()


def test_arrays_of_observations_get_a_name_and_a_name_that_is_taken_is_refused():
    class Point(gym.Env):
        observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        action_space = gym.spaces.Discrete(2)

        def __init__(self):
            self.client, self.x = None, 0.0

        def reset(self, *, seed=None, options=None):
            if self.client is None:  # as pybullet_envs do
                self.client = BulletClient(pybullet.DIRECT)
                self.ball = box(self.client, [0, 0, 0.3])
            self.x = 0.0
            self.client.resetBasePositionAndOrientation(self.ball, [0, 0, 0.3], [0, 0, 0, 1])
            return np.zeros(2, np.float32), {}

        def step(self, action):
            self.x += 0.1
            self.client.resetBasePositionAndOrientation(self.ball, [self.x, 0, 0.3], [0, 0, 0, 1])
            return np.zeros(2, np.float32), 0.0, False, False, {}

    def camera(env):
        return BulletCamera(env.client, 60, 40, fov_deg=60, view=VIEW)

    env = BulletFlow(Point(), camera)
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"observation", "sensor"}
    assert env.observation_space.contains(observation)
    moved = env.step(0)[0]["sensor"]["instance_motion"][1]
    assert np.linalg.norm(moved[:3, 3]) == pytest.approx(0.1, abs=1e-6)
    lasting = BulletFlow(env.env, camera(env.unwrapped))
    assert np.array_equal(lasting.reset()[0]["sensor"]["prev_from_curr"], np.eye(4))
    with pytest.raises(ValueError, match="'sensor'"):
        BulletFlow(env, camera)


# OpenGL, in a process of its own: a driver that fails may take its process with it

EGL = f"""
import importlib.util
import numpy as np, pybullet
from flowrep.pybullet import BulletCamera
{"".join(map(inspect.getsource, (box, column_major, heights)))}
client = pybullet.connect(pybullet.DIRECT)
plugin = importlib.util.find_spec("eglRenderer").origin
assert pybullet.loadPlugin(plugin, "_eglRendererPlugin") >= 0
box(pybullet, [0, 0, -5], half=(9, 9, 5))
view = pybullet.computeViewMatrix([0, -1, 0.9], [0.2, 0.3, 0], [0.3, 0.1, 1])
camera = BulletCamera(client, 132, 90, fov_deg=60, near_m=0.5, far_m=5.0, view=view)
depth = camera.reset()["depth"][0]
near = depth < 2.5
print(near.sum(), *(
    abs(heights(depth, K, view)[near]).mean()
    for K in (camera.K, camera.K + [[0, 0, 0.5], [0, 0, -0.5], [0, 0, 0]])
))
"""


@pytest.mark.slow
def test_egls_plugin_samples_at_the_centres_of_pixels_and_is_noticed():
    if importlib.util.find_spec("eglRenderer") is None:
        pytest.skip("this PyBullet has no EGL plugin")
    result = run_python("-c", EGL, timeout=120)
    if result.returncode != 0:
        pytest.skip("EGL can't draw here: apt-get install libegl1 libgl1-mesa-dri")
    lines = [line for line in result.stdout.splitlines() if line[:1].isdigit()]
    pixels, flat, as_software = map(float, lines[-1].split())
    assert pixels > 2000
    assert flat < 1e-4  # its depth has 16 bits: 0.5 to 5 m in steps of 0.3 mm at 2.5 m
    assert as_software > 1e-3
