"""Flow in MuJoCo, verified by warping: what a pixel shows now was seen where flow says it was.

MuJoCo draws in a process of its own: a graphics driver that fails may take its process with it.
"""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from flowrep.geometry import invert_rigid, transform_points, unproject

pytest.importorskip("gymnasium", reason="the example wraps a gymnasium env")
if importlib.util.find_spec("mujoco") is None:
    pytest.skip(
        "MuJoCo is not installed: pip install 'flowrep-rl[examples]'", allow_module_level=True
    )

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 120
STEPS = slice(1, None), slice(None, -1)  # each frame, and the one before it
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
import numpy as np
from examples.mujoco_flow import K, Yard, make_env

def poses(yard):
    "Camera and bodies as MuJoCo's own rotation matrices, camera axes by hand: y and z turned over."
    eye, moving = yard.data.camera("eye"), yard.body_ids
    pairs = [(eye.xmat.reshape(3, 3) * [1, -1, -1], eye.xpos)]
    pairs += [(yard.data.xmat[i].reshape(3, 3), yard.data.xpos[i]) for i in moving]
    rows = [np.vstack([np.column_stack(pair), [0, 0, 0, 1]]) for pair in pairs]
    return torch.tensor(np.stack(rows))

env = make_env()
frames = env.rollout(10, policy=lambda td: td.set("action", torch.tensor(1)))["next"]
record = {"frames": frames.to_dict(), "K": K}
env.close()

yard = Yard()
yard.reset(seed=0)
record["before"] = poses(yard)
yard.step(1)
record["now"] = poses(yard)

roll = 0.3  # so that the floor's depth changes along rows and along columns
yard.data.mocap_quat[0] = math.cos(roll / 2), 0.0, math.sin(roll / 2), 0.0
mujoco.mj_forward(yard.model, yard.data)
_, depth, body = yard.pictures()
record["rolled"] = {
    "world_from_cam": poses(yard)[0],
    "depth": torch.from_numpy(depth),
    "body": torch.from_numpy(body),
}
yard.close()
torch.save(record, sys.argv[1])
"""


def run_python(*arguments: str, backend: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"MUJOCO_GL": backend, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S
    )


def can_draw(backend: str) -> bool:
    try:
        return run_python("-c", PROBE, backend=backend).returncode == 0
    except subprocess.TimeoutExpired:
        return False


@pytest.fixture(scope="module")
def backend():
    asked = os.environ.get("MUJOCO_GL")
    for backend in [asked] if asked else ["egl", "osmesa"]:
        if can_draw(backend):
            return backend
    pytest.skip("MuJoCo can't draw off-screen here: apt-get install libegl1 libgl1-mesa-dri")


@pytest.fixture(scope="module")
def record(backend, tmp_path_factory):
    path = tmp_path_factory.mktemp("yard") / "record.pt"
    result = run_python("-c", RECORD, str(path), backend=backend)
    assert result.returncode == 0, result.stderr
    return torch.load(path, weights_only=True)


@pytest.fixture(scope="module")
def drive(record):
    """Returns K and ten frames of a drive with a turn: what was sensed and the flow made of it."""
    frames = record["frames"]
    flows = {name: frames[name] for name in ("raw", "ego", "obj")}
    return record["K"], frames["sensor"] | flows


def pixel_grid(height: int, width: int) -> Tensor:
    """Returns the centres (u, v) of all pixels, [2, H, W]."""
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([u, v])


def sample(maps: Tensor, at: Tensor, mode: str = "bilinear") -> Tensor:
    """Returns maps [T, C, H, W] at the pixel coordinates `at` [T, 2, H, W]."""
    height, width = maps.shape[-2:]
    size = torch.tensor([width, height]).reshape(2, 1, 1)
    grid = (2 * at / size - 1).movedim(-3, -1)  # halves are centres: align_corners=False
    return functional.grid_sample(maps.float(), grid, mode=mode, align_corners=False)


def test_mujoco_samples_pixels_at_their_centres_in_metres_along_z(record):
    depth, body = record["rolled"]["depth"].double(), record["rolled"]["body"]
    floor = (body <= 0) & (pixel_grid(*depth.shape)[1] > 80) & (depth < 10)
    assert floor.sum() > 500

    def distance_from_the_floor(shift_u: float, shift_v: float) -> float:
        K = record["K"].double()
        K[:2, 2] += torch.tensor([shift_u, shift_v])
        points = transform_points(record["rolled"]["world_from_cam"], unproject(depth[None], K))
        return points[..., 2][floor].abs().median().item()

    assert distance_from_the_floor(0, 0) < 1e-5
    for shift in [(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)]:  # half a pixel beside
        assert distance_from_the_floor(*shift) > 1e-3


def test_the_parts_add_up_and_only_what_moves_lights_up(drive):
    _, frames = drive
    torch.testing.assert_close(frames["raw"], frames["ego"] + frames["obj"], atol=1e-5, rtol=0)
    speed, body = frames["obj"].norm(dim=-3, keepdim=True), frames["instance"]
    assert (speed[body == 0] == 0).all()
    moving = [i for i in body.unique().tolist() if i]
    assert len(moving) == 3  # the ball, the door and the crate
    for i in moving:
        assert speed[body == i].median() > 0.3
    floor = (body == 0) & (frames["depth"] < 3)
    assert frames["ego"].norm(dim=-3, keepdim=True)[floor].median() > 2


def test_a_pixel_warped_by_raw_flow_lands_on_its_own_surface(drive):
    K, frames = drive
    now, before = ({name: maps[part] for name, maps in frames.items()} for part in STEPS)
    depth, body = now["depth"], now["instance"]
    was_at = pixel_grid(*depth.shape[-2:]) - now["raw"]
    # Where the point was, by its own body's motion, and how far the picture of before says it was.
    known = torch.isfinite(depth)
    points = unproject(torch.where(known, depth, 1.0), K)
    rows = torch.arange(len(depth)).reshape(-1, 1, 1)
    motion = now["instance_motion"][rows, body[:, 0].long()]
    points_prev = (motion[..., :3, :3] @ points.unsqueeze(-1)).squeeze(-1) + motion[..., :3, 3]
    inverse_then = sample(1 / before["depth"], was_at)[:, 0]  # linear on a plane
    body_then = sample(before["instance"], was_at, "nearest")
    inside = ((was_at > 1) & (was_at < torch.tensor([143.0, 95.0]).reshape(2, 1, 1))).all(1)
    seen = inside & known[:, 0]
    for i in body.unique().tolist():
        mine = seen & (body[:, 0] == i)
        assert (body_then[:, 0] == i)[mine].float().mean() > 0.9  # all but what was hidden
        error = (inverse_then * points_prev[..., 2] - 1).abs()[mine]
        assert error.median() < 2e-3


def test_the_picture_before_warped_by_raw_flow_is_the_picture_now(drive):
    _, frames = drive
    now, before = ({name: maps[part] for name, maps in frames.items()} for part in STEPS)
    grid = pixel_grid(*now["raw"].shape[-2:])

    def difference(flow: Tensor, where: Tensor) -> float:
        warped = sample(before["rgb"], grid - flow)
        error = (warped - now["rgb"]).abs().mean(1, keepdim=True)
        return error[where].mean().item()

    body, near = now["instance"], now["depth"] < 6
    for where in ((body == 0) & near, body > 0):
        right = difference(now["raw"], where)
        # Rivals: no flow, the other sign, (row, column).
        for flow in (0 * now["raw"], -now["raw"], now["raw"].flip(-3)):
            assert right < 0.5 * difference(flow, where)
    # Ego flow alone does not explain what moves by itself.
    assert difference(now["raw"], body > 0) < 0.5 * difference(now["ego"], body > 0)


def test_the_motion_rows_are_what_the_simulator_did(record):
    corner = torch.tensor([0.4, -0.1, 0.3], dtype=torch.float64)  # fixed to a body
    (cam_now, *bodies_now), (cam_before, *bodies_before) = record["now"], record["before"]
    world = torch.eye(4, dtype=torch.float64)
    rows = record["frames"]["sensor"]["instance_motion"][0]
    for now, before, row in zip([world, *bodies_now], [world, *bodies_before], rows):
        point = transform_points(invert_rigid(cam_now) @ now, corner)
        want = transform_points(invert_rigid(cam_before) @ before, corner)
        torch.testing.assert_close(transform_points(row.double(), point), want, atol=1e-5, rtol=0)


def test_the_example_runs_and_writes_its_strip(backend, tmp_path):
    path = tmp_path / "strip.png"
    script = str(ROOT / "examples" / "mujoco_flow.py")
    result = run_python(script, str(path), backend=backend)
    assert result.returncode == 0, result.stderr
    assert "max |obj| of what stands   0.0e+00 px" in result.stdout
    assert path.read_bytes().startswith(b"\x89PNG")
