"""Flow in MuJoCo, verified by warping: what a pixel shows now was seen where flow says it was.

MuJoCo draws in a process of its own: a graphics driver that fails may take its process with it.
"""

import importlib.util
import os
import subprocess
from contextlib import suppress

import pytest
import torch
from tensordict import TensorDict

from flowrep import diagnose
from flowrep.geometry import transform_points, unproject
from tests.running import ENVIRONMENT, run_python

pytest.importorskip("gymnasium", reason="the example wraps a gymnasium env")
if importlib.util.find_spec("mujoco") is None:
    pytest.skip(
        "MuJoCo is not installed: pip install 'flowrep-rl[examples]'", allow_module_level=True
    )

TIMEOUT_S = 120
PROBE = """
import mujoco
scene = "<mujoco><worldbody><camera name='eye'/></worldbody></mujoco>"
model = mujoco.MjModel.from_xml_string(scene)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 8, 8)
renderer.update_scene(data, "eye")
renderer.render()
renderer.close()
"""
RECORD = """
import math, sys
import mujoco, torch
from examples import mujoco_flow
from examples.mujoco_flow import K, Yard, make_env

def recorded(steps):
    env = make_env()
    frames = env.rollout(steps, policy=lambda td: td.set("action", torch.tensor(1)))["next"]
    env.close()
    return frames.to_dict()

record = {"frames": recorded(10), "K": K}
scene = mujoco_flow.SCENE
markers = "".join(f"<site pos='{x} 3 .3' size='.2'/>" for x in range(-4, 4))
mujoco_flow.SCENE = scene.replace("</worldbody>", markers + "</worldbody>")
record["marked"] = recorded(2)
mujoco_flow.SCENE = scene

yard = Yard()
yard.reset(seed=0)
roll = 0.3  # so that the floor's depth changes along rows and along columns
yard.data.mocap_quat[0] = math.cos(roll / 2), 0.0, math.sin(roll / 2), 0.0
mujoco.mj_forward(yard.model, yard.data)
_, depth, segmentation = yard.pictures()
geom = torch.from_numpy(segmentation[..., 0]).long()
body = torch.as_tensor(yard.model.geom_bodyid)[geom.clamp(min=0)].where(geom >= 0, -1)
# MuJoCo's own rotation matrix; from its camera's axes to OpenCV's y and z are turned over.
eye, world_from_cam = yard.data.camera("eye"), torch.eye(4, dtype=torch.float64)
world_from_cam[:3, :3] = torch.tensor(eye.xmat.reshape(3, 3) * [1, -1, -1])
world_from_cam[:3, 3] = torch.tensor(eye.xpos)
record["rolled"] = {
    "world_from_cam": world_from_cam,
    "depth": torch.from_numpy(depth),
    "body": body,
}
yard.close()
torch.save(record, sys.argv[1])
mujoco_flow.main(sys.argv[2])
"""


def draw(*arguments, backend):
    return run_python(*arguments, env=ENVIRONMENT | {"MUJOCO_GL": backend}, timeout=TIMEOUT_S)


@pytest.fixture(scope="module")
def backend():
    asked = os.environ.get("MUJOCO_GL")
    for backend in [asked] if asked else ["egl", "osmesa"]:
        with suppress(subprocess.TimeoutExpired):
            if draw("-c", PROBE, backend=backend).returncode == 0:
                return backend
    pytest.skip("MuJoCo can't draw off-screen here: apt-get install libegl1 libgl1-mesa-dri")


@pytest.fixture(scope="module")
def drawn(backend, tmp_path_factory):
    """What the example says, its strip and the record, all from one process."""
    folder = tmp_path_factory.mktemp("yard")
    paths = folder / "record.pt", folder / "strip.png"
    result = draw("-c", RECORD, *paths, backend=backend)
    assert result.returncode == 0, result.stderr
    return result.stdout, *paths


@pytest.fixture(scope="module")
def record(drawn):
    return torch.load(drawn[1], weights_only=True)


def test_mujoco_samples_pixels_at_their_centres_in_metres_along_z(record):
    depth, body = record["rolled"]["depth"].double(), record["rolled"]["body"]
    floor = (body <= 0) & (depth < 10)
    floor[:80] = False  # the picture's lower end
    assert floor.sum() > 500

    def distance_from_the_floor(shift_u: float, shift_v: float) -> float:
        K = record["K"].double()
        K[:2, 2] += torch.tensor([shift_u, shift_v])
        points = transform_points(record["rolled"]["world_from_cam"], unproject(depth[None], K))
        return points[..., 2][floor].abs().median().item()

    assert distance_from_the_floor(0, 0) < 1e-5
    for shift in [(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)]:  # half a pixel beside
        assert distance_from_the_floor(*shift) > 1e-3


def test_each_frame_warps_into_the_one_before_and_only_what_moves_lights_up(record):
    frames = TensorDict(record["frames"], [10])
    # Not `is_right`: the depth of a floor hardly shows that a camera slides along it.
    assert not diagnose(frames, record["K"]).is_wrong
    speed, body = frames["obj"].norm(dim=-3, keepdim=True), frames["sensor", "instance"]
    assert (speed[body == 0] == 0).all()
    assert body.unique().tolist() == [0, 1, 2, 3]  # the ball, the door and the crate
    for i in (1, 2, 3):
        assert speed[body == i].median() > 0.3


def test_a_marker_with_the_number_of_a_body_s_geom_is_not_that_body(record):
    plain, marked = (TensorDict(record[name], [n]) for name, n in (("frames", 10), ("marked", 2)))
    is_site = marked["segmentation"][..., 1] == 6  # mjOBJ_SITE
    numbers = marked["segmentation"][..., 0][is_site].unique().tolist()
    assert {*numbers} & {*plain["segmentation"][..., 0].unique().tolist()}
    seen = marked["sensor", "instance"][:, 0]
    assert (seen[is_site] == 0).all()
    assert (seen == plain["sensor", "instance"][:2, 0])[~is_site].all()


def test_the_example_runs_and_writes_its_strip(drawn):
    said, _, strip = drawn
    assert "max |obj| of what stands   0.0e+00 px" in said
    assert strip.read_bytes().startswith(b"\x89PNG")
