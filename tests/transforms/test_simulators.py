"""Each simulator's row against buffers that are written as that simulator's makers document.

One scene is the truth: a camera that turns about all its axes before two bodies that move by
themselves. `truth` computes flow from points, in numpy; each writer turns the scene into one
simulator's buffers, with scipy's rotations. None of flowrep's code is asked for either.
"""

import functools
import importlib.util
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, TransformedEnv, check_env_specs

from flowrep import diagnose
from flowrep.transforms import CONVENTIONS, FlowFactorize, RawFlow, sensors_from
from tests.running import ENVIRONMENT, run_python
from tests.transforms.fake_env import FakeSensorEnv

STEPS, HEIGHT, WIDTH = 4, 5, 7
K = np.array([[6.0, 0.0, 3.2], [0.0, 5.0, 2.1], [0.0, 0.0, 1.0]])
FAR_M, NEAR_M = 20.0, 0.1
IDS = (41, 17)  # of the bodies, in the order of their poses
GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])


def rigid(euler_deg, position):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", euler_deg, degrees=True).as_matrix()
    pose[:3, 3] = position
    return pose


def scene(t):
    """Depth z (inf is sky), the body of each pixel (-1: none), K's poses and the bodies', at t."""
    random = np.random.default_rng(7)  # the same picture at all times, as only motion matters here
    z = np.round(random.uniform(2.0, 6.0, (HEIGHT, WIDTH)), 3) + 0.125 * t
    body = random.integers(-1, 2, (HEIGHT, WIDTH))
    z[0, :3], body[0, :3] = np.inf, -1
    world_from_cam = rigid((-80 + 2 * t, 5 * t, 30 + 4 * t), (1 + 0.2 * t, -2 + 0.3 * t, 1.5))
    bodies = [
        rigid((10 * t, 20, 5 * t), (2 + 0.1 * t, 3, 0.5)),
        rigid((15, -7 * t, 40), (0, 4 - 0.15 * t, 1 + 0.05 * t)),
    ]
    return z, body, world_from_cam, np.array(bodies)


def truth(t, own_motion=True):
    """Flow p_t - p_t' [H, W, 2] of each pixel, through the world."""
    z, body, camera, bodies = scene(t)
    _, _, camera_before, bodies_before = scene(t - 1)
    flow = np.zeros((HEIGHT, WIDTH, 2))
    for j, i in np.ndindex(HEIGHT, WIDTH):
        p = np.array([i + 0.5, j + 0.5, 1.0])
        ray = np.linalg.inv(K) @ p
        point = np.append(ray, 0.0) if np.isinf(z[j, i]) else np.append(ray * z[j, i], 1.0)
        point = camera @ point
        if own_motion and body[j, i] >= 0:
            k = body[j, i]
            point = bodies_before[k] @ np.linalg.inv(bodies[k]) @ point
        before = K @ (np.linalg.inv(camera_before) @ point)[:3]
        flow[j, i] = (p - before / before[2])[:2]
    return flow


# Writers


def ray_lengths(z):
    v, u = np.indices(z.shape) + 0.5
    return z * np.sqrt(1 + ((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2)


def sky_is(value, z):
    return np.where(np.isinf(z), value, z).astype(np.float32)


def xyzw(pose):
    return Rotation.from_matrix(pose[..., :3, :3]).as_quat()


def wxyz(pose):
    return np.roll(xyzw(pose), 1, axis=-1)


def seven(pose, quaternion):
    return np.concatenate([pose[..., :3, 3], quaternion(pose)], -1).astype(np.float32)


def apart(position, rotation, pose, quaternion=wxyz):
    """Position and quaternion under a key each."""
    return {position: pose[..., :3, 3], rotation: quaternion(pose).astype(pose.dtype)}


def names(body, background):
    return np.array([*IDS, background])[body]  # -1 is the last


def isaac_lab(z, body, camera, bodies, flow, quaternion=xyzw):
    u, v = flow
    ids = names(body, 1)[..., None].astype(np.int32)
    return {
        "distance_to_image_plane": z[..., None].astype(np.float32),
        "distance_to_camera": ray_lengths(z)[..., None].astype(np.float32),
        **apart("pos_w", "quat_w_ros", camera.astype(np.float32), quaternion),  # ROS's is OpenCV's
        "body_link_pose_w": seven(bodies, quaternion),
        "instance_segmentation": ids,  # 3.0's
        "instance_id_segmentation_fast": ids,  # 2.x's
        # left and up are positive
        "motion_vectors": np.stack([-u, -v], -1).astype(np.float32),
    }


def maniskill(z, body, camera, bodies, _):
    return {
        "depth": np.round(1000 * sky_is(0, z))[..., None].astype(np.int16),
        "cam2world_gl": (camera @ GL_FROM_CV).astype(np.float32),
        "body_poses": bodies.astype(np.float32),
        "segmentation": names(body, 0)[..., None].astype(np.int16),
    }


def mujoco(z, body, camera, bodies, _):
    geom = 5  # mjOBJ_GEOM
    segmentation = np.stack([names(body, -1), np.where(body < 0, -1, geom)], -1)
    return {
        "depth": sky_is(FAR_M * 0.9997, z),  # as float32 leaves it
        "camera_pose": camera @ GL_FROM_CV,
        **apart("xpos", "xquat", bodies),
        "segmentation": segmentation.astype(np.int32),
    }


def mjlab(z, *others):
    buffers = {name: np.float32(value) for name, value in mujoco(z, *others).items()}
    buffers["segmentation"] = buffers["segmentation"].astype(np.int32)
    return buffers | {"depth": sky_is(0, z)[..., None]}


def newton(z, body, camera, bodies, _):
    return {
        "forward_depth": sky_is(0, z),
        "depth": sky_is(0, ray_lengths(z)),
        "camera_transforms": seven(camera @ GL_FROM_CV, xyzw),
        "body_q": seven(bodies, xyzw),
        "shape_index": names(body, 0xFFFFFFFF).astype(np.uint32),
    }


def genesis(z, body, camera, bodies, _):
    return {
        "depth": sky_is(FAR_M, z),
        "transform": camera @ GL_FROM_CV,
        **apart("links_pos", "links_quat", bodies.astype(np.float32)),
        "segmentation": names(body, 0).astype(np.int32),
    }


def habitat(z, body, camera, bodies, _):
    y_up = rigid((-90, 0, 0), (0, 0, 0))
    camera, bodies = y_up @ camera @ GL_FROM_CV, y_up @ bodies
    return {
        "depth_sensor": sky_is(0, z),
        **apart("position", "rotation", camera),
        **apart("object_position", "object_rotation", bodies),
        "semantic_sensor": names(body, 0).astype(np.int32),
    }


def kubric(z, body, camera, bodies, flow):
    u, v = flow
    return {
        "depth": ray_lengths(sky_is(1e10, z))[..., None].astype(np.float32),
        "z": sky_is(1e10, z)[..., None],
        **apart("positions", "quaternions", camera @ GL_FROM_CV),
        **apart("instance_positions", "instance_quaternions", bodies),
        "segmentations": names(body, 0)[..., None].astype(np.uint8),
        "backward_flow": np.stack([-v, -u], -1).astype(np.float32),  # (row, column), to t - 1
    }


def mirrored(pose, world, own):
    """A pose in a left-handed world and its own axes, each a signed permutation's matrix."""
    flip_world, flip_own = np.eye(4), np.eye(4)
    flip_world[:3, :3], flip_own[:3, :3] = world, own
    turned = flip_world @ pose @ np.linalg.inv(flip_own)
    assert np.all(np.linalg.det(turned[..., :3, :3]) > 0)
    return turned


def ai2thor(z, body, camera, bodies, _):
    y_up = np.array([[0, -1, 0], [0, 0, 1], [1, 0, 0]])  # Unity's x right, y up, z ahead
    camera_axes = np.diag([1.0, -1.0, 1.0])
    return {
        "depth_frame": sky_is(FAR_M, z),
        "camera_pose": mirrored(camera, y_up, camera_axes).astype(np.float32),
        "object_poses": mirrored(bodies, y_up, y_up).astype(np.float32),
        "instance_ids": names(body, 0).astype(np.int32),
    }


def carla(z, body, camera, bodies, _):
    y_right = np.diag([1.0, -1.0, 1.0])
    camera_axes = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0]])  # x ahead, y right, z up
    normalised = np.where(np.isinf(z), 1.0, z / 1000)
    code = np.round(normalised * (256**3 - 1)).astype(np.int64)
    r, g, b = code % 256, code // 256 % 256, code // 65536
    return {
        "depth": (r + 256 * g + 65536 * b).astype(np.int32),
        "transform": mirrored(camera, y_right, camera_axes),
        "actor_transforms": mirrored(bodies, y_right, y_right),
        "instance": names(body, 0).astype(np.int32),
    }


def airsim(z, body, camera, bodies, _):
    ned = rigid((180, 0, 0), (0, 0, 0))  # x ahead, y right, z down
    camera_axes = np.eye(4)
    camera_axes[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    camera, bodies = ned @ camera @ camera_axes.T, ned @ bodies
    return {
        "DepthPlanar": sky_is(65504, z),
        "DepthPerspective": sky_is(65504, ray_lengths(z)),
        **apart("camera_position", "camera_orientation", camera),
        **apart("object_positions", "object_orientations", bodies),
        "segmentation": names(body, 0).astype(np.int32),
    }


def pybullet(z, body, camera, bodies, _):
    buffer = FAR_M * (1 - NEAR_M / z) / (FAR_M - NEAR_M)
    buffer[np.isinf(z)] = 1.0
    return {
        "depth": buffer.astype(np.float32),
        "view": np.linalg.inv(camera @ GL_FROM_CV),
        **apart("positions", "orientations", bodies, xyzw),
        "segmentation": names(body, -1).astype(np.int32),
    }


_WRITERS = (
    *(isaac_lab, maniskill, mujoco, mjlab, newton, genesis, habitat, kubric, ai2thor, carla),
    *(airsim, pybullet),
)
WRITERS = {writer.__name__: writer for writer in _WRITERS}
WRITERS["isaac_lab_2"] = functools.partial(isaac_lab, quaternion=wxyz)


def buffers_of(simulator, t):
    """What a simulator's writer makes of the scene, and of its flow (u, v) since the last step."""
    flow = truth(t) if t else np.zeros((HEIGHT, WIDTH, 2))
    return WRITERS[simulator](*scene(t), np.moveaxis(flow, -1, 0))


ARGUMENTS = {
    "mujoco": {"far_m": FAR_M},
    "genesis": {"far_m": FAR_M},
    "kubric": {"intrinsics": K},
    "ai2thor": {"far_m": FAR_M},
    "airsim": {"far_m": 65504.0},
    "pybullet": {"near_m": NEAR_M, "far_m": FAR_M},
}


class Replayed(FakeSensorEnv):
    """Gives the buffers that `writer` makes of a time, under "camera", in an episode of 3 steps."""

    def __init__(self, writer):
        super().__init__()
        self.write = writer
        first = {name: torch.as_tensor(value) for name, value in writer(0).items()}
        specs = {name: Unbounded(x.shape, dtype=x.dtype) for name, x in first.items()}
        self.observation_spec = Composite(camera=Composite(specs))

    def _observe(self):
        buffers = {name: torch.as_tensor(x) for name, x in self.write(self.steps[0]).items()}
        return TensorDict(camera=TensorDict(buffers))


def rollout(simulator, writer=None, **options):
    sensors = sensors_from(simulator, prefix="camera", **options)
    stack = [RawFlow(K), FlowFactorize(K)]
    if options.get("flow"):
        stack = stack[1:]
    env = TransformedEnv(
        Replayed(writer or functools.partial(buffers_of, simulator)), Compose(*sensors, *stack)
    )
    check_env_specs(env)
    return env.rollout(STEPS)["next"]


def assert_is_the_truth(frames, *, bodies=True, pixels=2e-3):
    assert len(frames) == STEPS - 1
    for t, seen in enumerate(frames, start=1):
        z = scene(t)[0]
        depth = seen["sensor", "depth"][0].numpy()
        assert np.array_equal(np.isinf(depth), np.isinf(z))
        np.testing.assert_allclose(depth, z, rtol=1e-4)
        raw, ego = truth(t), truth(t, own_motion=False)
        for name, want in (("ego", ego), ("raw", raw), ("obj", raw - ego)):
            if bodies or name == "ego":
                got = seen[name].movedim(0, -1)
                np.testing.assert_allclose(got, want, atol=pixels, err_msg=f"{name} at {t}")
    assert abs(raw - ego).max() > 0.3


# Each simulator as it is, by its other kinds of depth, and by its flow, without any body's pose.
READINGS = [(simulator, {"body_ids": IDS}) for simulator in CONVENTIONS]
READINGS += [
    (simulator, {"body_ids": IDS, "depth": depth})
    for simulator, row in CONVENTIONS.items()
    for depth in list(row.depth)[1:]
    if depth in buffers_of(simulator, 0)
]
READINGS += [(simulator, {"flow": True}) for simulator, row in CONVENTIONS.items() if row.flow]


@pytest.mark.parametrize(("simulator", "options"), READINGS, ids=str)
def test_a_simulators_buffers_become_the_scene_that_they_were_made_of(simulator, options):
    given = ARGUMENTS.get(simulator, {})
    if "depth" in options:  # only some kinds need K
        needed = {"intrinsics"} & set(CONVENTIONS[simulator].depth[options["depth"]])
        given = {k: v for k, v in given.items() if k != "intrinsics"} | dict.fromkeys(needed, K)
    assert_is_the_truth(rollout(simulator, **options, **given))


def test_without_bodies_nothing_else_is_read():
    sensors = sensors_from("maniskill", prefix=("a", "b"))
    read = {key for transform in sensors for key in transform.in_keys}
    assert {key[2] for key in read if key[0] == "a"} == {"depth", "cam2world_gl"}
    written = {key for transform in sensors for key in transform.out_keys if key[0] == "sensor"}
    assert {key[1] for key in written} == {"depth", "world_from_cam", "prev_from_curr"}


@pytest.mark.parametrize("depth", ["distance_to_image_plane", "distance_to_camera"])
@pytest.mark.parametrize(("background_m", "options"), [(0.0, {}), (50.0, {"far_m": 50.0})])
def test_isaac_labs_depth_may_be_clipped_to_zero_or_to_the_far_plane(depth, background_m, options):
    def clipped(t):
        buffers = buffers_of(
            "isaac_lab", t
        )  # zero is Newton Warp's background without clipping, too
        return buffers | {depth: np.where(np.isinf(buffers[depth]), background_m, buffers[depth])}

    rays = {"intrinsics": K} if depth == "distance_to_camera" else {}
    options = options | rays
    assert_is_the_truth(rollout("isaac_lab", clipped, depth=depth, body_ids=IDS, **options))


@pytest.mark.parametrize("simulator", CONVENTIONS)
def test_colours_are_not_taken_for_ids(simulator):
    row = CONVENTIONS[simulator]

    def colourful(t):
        colours = np.random.default_rng(t).integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)
        return buffers_of(simulator, t) | {row.ids["key"]: colours}

    with pytest.raises(ValueError, match=re.escape(row.ids["if_colours"])):
        rollout(simulator, colourful, body_ids=IDS, **ARGUMENTS.get(simulator, {}))


@pytest.mark.parametrize(("simulator", "other"), [("mujoco", 6), ("mjlab", 9)])  # a site, a flex
def test_sites_and_flexes_are_no_bodies_and_are_named(simulator, other):
    def with_marker(t):
        buffers = buffers_of(simulator, t)
        segmentation = buffers["segmentation"].copy()
        segmentation[4, :3] = IDS[0], other  # its number is that of the first body's geom
        return buffers | {"segmentation": segmentation}

    with pytest.warns(UserWarning, match=f"{100_000 * (1 + other) + IDS[0]} "):
        frames = rollout(simulator, with_marker, body_ids=IDS, **ARGUMENTS.get(simulator, {}))
    assert (frames["sensor", "instance"][:, 0, 4, :3] == 0).all()
    assert (frames["obj"][:, :, 4, :3] == 0).all()
    body = scene(1)[1]
    others = np.delete(body.ravel(), range(4 * WIDTH, 4 * WIDTH + 3)) + 1
    seen = frames["sensor", "instance"][0].numpy().ravel()
    assert np.delete(seen, range(4 * WIDTH, 4 * WIDTH + 3)).tolist() == others.tolist()


def test_keys_may_be_elsewhere():
    def moved(t):
        buffers = buffers_of("maniskill", t)
        return {"z" if name == "depth" else name: value for name, value in buffers.items()}

    frames = rollout("maniskill", moved, body_ids=IDS, keys={"depth": ("camera", "z")})
    assert_is_the_truth(frames)


PAGE = Path(__file__).parents[2] / "docs" / "in_your_simulator.md"


def test_the_page_names_every_simulator_and_its_python_runs():
    page = PAGE.read_text("utf-8")
    assert [name for name in CONVENTIONS if f'`"{name}"`' not in page] == []
    pytest.importorskip("pybullet")
    scope: dict = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, scope)
    assert np.array_equal(scope["sensor"]["prev_from_curr"], np.eye(4))
    assert len(scope["isaac_lab"]) == len(sensors_from("isaac_lab", flow=True)) + 1
    scope["pybullet"].disconnect(scope["client"])


# On the simulator itself; MuJoCo's, mjlab's and ManiSkill's rows are tested by tests/examples


def assert_warps(simulator, frames, K, differing=0.0, **options):
    """Each frame, warped by its flow, is the one before; the sky is where no id is."""
    buffers = [TensorDict({k: torch.as_tensor(v) for k, v in each.items()}) for each in frames]
    done = torch.zeros(len(frames), 1, dtype=torch.bool)
    td = TensorDict({"camera": torch.stack(buffers), "next": {"done": done}}, [len(frames)])
    td.names = ["time"]
    sensors = sensors_from(simulator, prefix="camera", **options)
    td = Compose(*sensors, RawFlow(K), FlowFactorize(K))(td)
    ids = CONVENTIONS[simulator].ids
    (background,) = ids["background"] or (-1,)
    sky = td["adapted", ids["key"]][:, 0] == background
    is_inf = td["sensor", "depth"].isinf()[:, 0]
    assert sky.any()
    assert (is_inf != sky).float().mean() <= differing
    found = diagnose(td, K)
    # The floor alone stands still, and its depth doesn't show that a camera slides along it.
    assert not found.is_wrong, found


def test_pybullet_itself():
    bullet = pytest.importorskip("pybullet")
    height, width = 120, 180
    client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
    sides = ([5, 5, 0.1], [0.4, 0.3, 0.2], [0.2, 0.3, 0.4])
    boxes = [
        bullet.createMultiBody(
            0, -1, bullet.createVisualShape(bullet.GEOM_BOX, halfExtents=half, **client), **client
        )
        for half in sides
    ]
    projection = bullet.computeProjectionMatrixFOV(60, width / height, NEAR_M, FAR_M)
    frames = []
    for t in range(5):
        turns = [[0, 0, 0], [0.2 * t, 0.1 * t, 0.1], [0.1, 0, -0.2 * t]]
        places = [[0, 0, -0.1], [0.4 - 0.1 * t, 0.5, 0.6], [-0.6, 0.1 * t, 0.5]]
        for box, turn, place in zip(boxes, turns, places):
            quaternion = bullet.getQuaternionFromEuler(turn)
            bullet.resetBasePositionAndOrientation(box, place, quaternion, **client)
        view = bullet.computeViewMatrix(
            [1.5 - 0.06 * t, -2.5 + 0.1 * t, 1.5], [0, 0.04 * t, 0.6], [0.1, 0, 1]
        )
        picture = {"renderer": bullet.ER_TINY_RENDERER, **client}
        _, _, _, buffer, ids = bullet.getCameraImage(width, height, view, projection, **picture)
        poses = [bullet.getBasePositionAndOrientation(box, **client) for box in boxes[1:]]
        frames.append(
            {
                "depth": np.reshape(buffer, (height, width)),
                "segmentation": np.reshape(ids, (height, width)),
                "view": np.reshape(view, (4, 4)).T,
                "positions": np.array([place for place, _ in poses]),
                "orientations": np.array([quaternion for _, quaternion in poses]),
            }
        )
    bullet.disconnect(**client)
    focal = height / 2 / math.tan(math.radians(30))
    # The software renderer samples pixel (i, j) at u = i, v = j + 1.
    sampled = np.array([[focal, 0, width / 2 + 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    options = {"body_ids": boxes[1:], "static_ids": boxes[:1], "near_m": NEAR_M, "far_m": FAR_M}
    assert_warps("pybullet", frames, sampled, **options)


GENESIS = """
import sys
import numpy as np, genesis, torch
from scipy.spatial.transform import Rotation

genesis.init(backend=genesis.cpu, logging_level="error")
scene = genesis.Scene(
    show_viewer=False,
    vis_options=genesis.options.VisOptions(segmentation_level="link"),
    sim_options=genesis.options.SimOptions(gravity=(0, 0, 0)),
)
scene.add_entity(genesis.morphs.Plane())
bodies = [
    scene.add_entity(genesis.morphs.Box(size=(0.6, 0.5, 0.4))),
    scene.add_entity(genesis.morphs.Sphere(radius=0.3)),
]
camera = scene.add_camera(res=(180, 120), fov=60, near=0.1, far=20.0, GUI=False)
scene.build()
frames = []
for t in range(5):
    turned = Rotation.from_euler("xyz", [10 * t, 5 * t, 8 * t], degrees=True).as_quat()
    bodies[0].set_pos((0.1 * t - 0.3, 0.05 * t, 0.6))
    bodies[0].set_quat(np.roll(turned, 1))
    bodies[1].set_pos((0.8, -0.06 * t, 0.5 + 0.03 * t))
    eye = (2 - 0.06 * t, -2 + 0.1 * t, 1.5)
    camera.set_pose(pos=eye, lookat=(0, 0.04 * t, 0.5), up=(0.05 * t, 0, 1))
    _, depth, ids, _ = camera.render(depth=True, segmentation=True, force_render=True)
    frames.append({
        "depth": np.array(depth),
        "segmentation": np.array(ids, dtype=np.int32),
        "transform": np.array(camera.transform),
        "links_pos": np.stack([np.asarray(body.get_pos()).reshape(3) for body in bodies]),
        "links_quat": np.stack([np.asarray(body.get_quat()).reshape(4) for body in bodies]),
    })
by_link = {link: number for number, link in scene.segmentation_idx_dict.items()}
ids = [by_link[body.idx, body.base_link.idx] for body in bodies]
torch.save({"frames": frames, "K": np.array(camera.intrinsics), "ids": ids}, sys.argv[1])
"""


@pytest.mark.slow
def test_genesis_itself(tmp_path):
    if importlib.util.find_spec("genesis") is None:
        pytest.skip("pip install genesis-world; it runs on a CPU, with EGL")
    # in a process of its own: a graphics driver that fails may take its process with it
    environment = ENVIRONMENT | {"PYOPENGL_PLATFORM": "egl"}
    result = run_python("-c", GENESIS, tmp_path / "frames.pt", env=environment, timeout=500)
    if result.returncode != 0:
        pytest.skip(f"Genesis can't draw here: {result.stderr.strip().splitlines()[-1:]}")
    seen = torch.load(tmp_path / "frames.pt", weights_only=False)
    others = [number for number in range(8) if number not in seen["ids"]]
    options = {"body_ids": seen["ids"], "static_ids": others, "far_m": FAR_M}
    # 0.4 % differ: its ids aren't multisampled as its depth is, and the floor's end is sky
    assert_warps("genesis", seen["frames"], seen["K"], differing=0.01, **options)
