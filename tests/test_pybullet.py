"""PyBullet cameras against PyBullet itself: its pictures, its ids and its kinematics.

What is expected comes from `getCameraImage` and `getLinkState`, not from flowrep's code.
"""

import importlib.util
import inspect
import math
import os
from functools import partial

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
CV_FROM_GL = np.diag([1, -1, -1, 1])
OFF_CENTRE = pybullet.computeProjectionMatrix(-0.07, 0.03, -0.02, 0.05, 0.1, 20.0)
PLANE = 0


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
        {"projection": OFF_CENTRE},
        {"projection": np.reshape(OFF_CENTRE, (4, 4))},
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


def test_maps_show_the_bodies_and_links(world):
    crate = box(world, [0, 0, 0.06])
    world.loadURDF("kuka_iiwa/model.urdf", [-0.3, 0.2, 0], useFixedBase=True)
    options = {"fov_deg": 60, "view": VIEW}
    plain = BulletCamera(world, 60, 40, **options)
    full = BulletCamera(world, 60, 40, rgb=True, classes={crate: 3, PLANE: 1, 9: 2}, **options)
    assert set(plain.reset()) == {"depth", "instance", "prev_from_curr", "instance_motion"}
    seen = full.reset()
    assert seen["rgb"].shape == (3, 40, 60)
    assert seen["rgb"].dtype == np.uint8
    assert full.space().contains(seen)
    flags = pybullet.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX
    projection = full._picture["projectionMatrix"]
    _, _, rgba, _, ids = world.getCameraImage(60, 40, VIEW, projection, shadow=0, flags=flags)
    ids = np.reshape(ids, (40, 60))
    assert len(np.unique(ids)) > 6
    for (body, link), row in full.rows.items():
        here = ids == body + ((link + 1) << 24)
        np.testing.assert_array_equal(seen["instance"][0] == row, here)
        assert (seen["semantic"][0, here] == {crate: 3, PLANE: 1}.get(body, 0)).all()
    assert (seen["semantic"][seen["instance"] == 0] == 0).all()
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
    camera = BulletCamera(world, 8, 6, fov_deg=60)
    camera.reset(VIEW)
    before = [pose_of(world, robot, link) for link in (-1, *links)]
    for _ in range(4):
        world.stepSimulation()
    view = pybullet.computeViewMatrix([1.05, -0.95, 0.8], [0.1, 0.01, 0.3], [0.1, 0, 1])
    seen = camera(view)
    rows = seen["instance_motion"]
    prev_from_world = CV_FROM_GL @ column_major(VIEW)
    world_from_cam = np.linalg.inv(CV_FROM_GL @ column_major(view))
    np.testing.assert_allclose(seen["prev_from_curr"], prev_from_world @ world_from_cam, atol=2e-6)
    for link, old in zip((-1, *links), before):
        new = pose_of(world, robot, link)
        expected = prev_from_world @ old @ np.linalg.inv(new) @ world_from_cam
        np.testing.assert_allclose(rows[camera.rows[robot, link]], expected, atol=2e-6)
        assert abs(expected - prev_from_world @ world_from_cam).max() > 1e-3


def test_a_camera_on_a_link_moves_with_the_link(world):
    robot = world.loadURDF("kuka_iiwa/model.urdf", useFixedBase=True)
    box(world, [0.5, 0.1, 0.06])
    world.resetJointState(robot, 3, -1.5)
    mount = pybullet.computeViewMatrix([0.1, 0.0, 0.05], [0.15, 0.0, 1.0], [1, 0, 0])

    def gl_from_world():
        """The mount's view in the axes of the link, as PyBullet reports them."""
        world_from_link = matrix(*world.getLinkState(robot, 6, computeForwardKinematics=1)[4:6])
        return column_major(mount) @ np.linalg.inv(world_from_link)

    camera = BulletCamera(world, 60, 40, fov_deg=70, view=mount, link=(robot, 6))
    camera.reset()
    before = gl_from_world()
    for link in (0, 1, 3, 5):
        world.resetJointState(robot, link, 0.2 - 0.3 * link)
    seen, now = camera(), gl_from_world()
    expected = CV_FROM_GL @ before @ np.linalg.inv(now) @ CV_FROM_GL
    np.testing.assert_allclose(seen["prev_from_curr"], expected, atol=2e-6)
    assert abs(expected - np.eye(4)).max() > 0.1
    # The camera's link stands still in the picture, which is that of a camera placed there.
    own = seen["instance_motion"][camera.rows[robot, 6]]
    np.testing.assert_allclose(own, np.eye(4), atol=2e-6)
    placed = BulletCamera(world, 60, 40, fov_deg=70, view=now.T.ravel().tolist()).reset()
    assert np.isclose(seen["depth"], placed["depth"], rtol=1e-4).mean() > 0.99


def flow_of(seen, K):
    """Raw flow [2, H, W] and where it is known, as `RawFlow` computes it."""
    maps = [torch.from_numpy(seen[name]) for name in ("depth", "instance", "instance_motion")]
    raw, known = rigid_flow(*maps[:2], torch.as_tensor(K), maps[2])
    return raw.numpy(), known[0].numpy()


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
    other = BulletClient(pybullet.DIRECT)
    ball, crate = box(other, [0, 0, 0.3]), box(world, [0, 0, 0.3])
    clients = world, world, other._client  # the last by its number
    first, second, third = (
        BulletCamera(client, 60, 40, fov_deg=60, view=VIEW) for client in clients
    )
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


def test_links_that_pybullet_hides_are_refused(world):
    ball = world.createVisualShape(pybullet.GEOM_SPHERE, 0.1)
    ball = world.createMultiBody(1.0, -1, ball, [0, 0, 0.3], useMaximalCoordinates=True)
    camera = BulletCamera(world, 60, 40, fov_deg=60, view=VIEW)
    assert (camera.reset()["instance"] == camera.rows[ball, -1]).sum() > 10
    with pytest.raises(ValueError, match=f"link -1 of body {ball}.*useMaximalCoordinates"):
        BulletCamera(world, 60, 40, fov_deg=60, link=(ball, -1)).reset()
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
    with pytest.raises(ValueError, match=f"link -1 of body {cloth}"):
        BulletCamera(world, 60, 40, fov_deg=60, link=(cloth, -1)).reset()


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({}, "fov_deg.*projection"),
        ({"fov_deg": 60, "projection": list(range(16))}, "not both"),
        ({"near_m": 0.1, "projection": list(range(16))}, "not both"),
        ({"projection": [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]}, "perspective"),
        ({"fov_deg": 180}, "fov_deg"),
        ({"fov_deg": 60, "near_m": 2, "far_m": 1}, "near_m"),
        ({"fov_deg": 60, "near_m": 0.001, "far_m": 1e5}, "far plane"),
        ({"fov_deg": 60, "max_instances": 0}, "max_instances"),
        ({"fov_deg": 60, "height": 0}, "height"),
        ({"fov_deg": 60, "view": None}, "view"),
        ({"fov_deg": 60, "view": [1.0] * 15}, "16"),
        ({"fov_deg": 60, "view": [2.0] * 16}, "rotation"),
        ({"fov_deg": 60, "view": column_major(VIEW)}, "column by column"),
        ({"fov_deg": 60, "view": [*VIEW[:12], math.nan, *VIEW[13:]]}, "rotation"),
        ({"fov_deg": 60, "physicsClientId": 0}, "client.*physicsClientId"),
        ({"fov_deg": 60, "projectionMatrix": [1.0] * 16}, "projection.*projectionMatrix"),
        ({"fov_deg": 60, "flags": pybullet.ER_NO_SEGMENTATION_MASK}, "ER_NO_SEGMENTATION_MASK"),
        ({"fov_deg": 60, "classes": {PLANE: 1, (PLANE, -1): 2}}, r"classes.*\(0, -1\): 2"),
        ({"fov_deg": 60, "classes": {PLANE: 256}}, "classes.*0: 256"),
        ({"fov_deg": 60, "link": (0, 3)}, r"link 3.*0: '0 links'"),
        ({"fov_deg": 60, "link": (7, -1)}, "body 7"),
    ],
)
def test_invalid_arguments_are_refused_by_name(world, options, names):
    with pytest.raises(ValueError, match=names):
        BulletCamera(world, **{"width": 60, "height": 40, "view": VIEW, **options}).reset()


# Envs of others


def made(name, package):
    pytest.importorskip(package, reason="an env that others wrote: pip install '.[examples]'")
    return gym.make(name)


def on_hand(env):
    from examples import pybullet_env

    return pybullet_env.on_hand(env)


def chasing(env):
    def view():
        x, y, z = env.robot.body_xyz
        eye, up = [x + 1.5, y + 1.5, z + 0.7], [0, 0, 1]
        return pybullet.computeViewMatrix(eye, [x, y, z], up)

    return BulletCamera(env._p, WIDTH, HEIGHT, fov_deg=60, view=view)


# Each with the number of a body that stands.
ENVS = {
    "panda, hand": (partial(made, "PandaPush-v3", "panda_gym"), on_hand, 2),
    "ant, chased": (partial(made, "AntBulletEnv-v0", "pybullet_envs_gymnasium"), chasing, 0),
}


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


class Sliding(gym.Env):
    """A box that slides 0.1 m a step. As in pybullet_envs, the first reset makes the client."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    client = None

    def reset(self, *, seed=None, options=None):
        if self.client is None:
            self.client = BulletClient(pybullet.DIRECT)
            self.box = box(self.client, [0, 0, 0.3])
        self.x = -0.1
        return self.step(0)[0], {}

    def step(self, action):
        self.x += 0.1
        self.client.resetBasePositionAndOrientation(self.box, [self.x, 0, 0.3], [0, 0, 0, 1])
        return np.zeros(2, np.float32), 0.0, False, False, {}


def test_arrays_of_observations_get_a_name_and_a_name_that_is_taken_is_refused():
    def camera(env, fov_deg=60):
        return BulletCamera(env.client, 60, 40, fov_deg=fov_deg, view=VIEW)

    env = BulletFlow(Sliding(), camera)
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"observation", "sensor"}
    assert env.observation_space.contains(observation)
    moved = env.step(0)[0]["sensor"]["instance_motion"][1]
    assert np.linalg.norm(moved[:3, 3]) == pytest.approx(0.1, abs=1e-6)
    lasting = BulletFlow(env.env, camera(env.unwrapped))
    assert np.array_equal(lasting.reset()[0]["sensor"]["prev_from_curr"], np.eye(4))
    with pytest.raises(ValueError, match="'sensor'"):
        BulletFlow(env, camera)
    angles = iter([60, 60, 70])
    env = BulletFlow(Sliding(), lambda env: camera(env, next(angles)))
    env.reset()
    with pytest.raises(ValueError, match=r"K was .* one size and projection"):
        env.reset()


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
