"""Flow in other simulators, checked by warping frames, where they are installed."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv, check_env_specs

from examples.maniskill_flow import ManiSkillEnv, flow_transforms
from flowrep import diagnose


def test_a_sliding_box_in_miniworld(monkeypatch):
    monkeypatch.setenv("PYGLET_HEADLESS", "1")  # MiniWorld opens a window when it is imported
    pytest.importorskip("miniworld", reason="pip install 'flowrep-rl[examples]'")
    from examples.miniworld_flow import K, drive, make_env

    env = make_env()
    frames = drive(env)
    env.close()
    assert diagnose(frames, K).is_right
    speed, row = speeds_and_rows(frames)
    assert (row == 1).any()
    assert speed[row == 1].median() > 0.5


def test_monsters_in_vizdoom(monkeypatch, tmp_path):
    pytest.importorskip("vizdoom", reason="pip install '.[examples]'")
    from examples.vizdoom_flow import K, make_env

    monkeypatch.chdir(tmp_path)  # ViZDoom writes a file where it runs
    env = make_env()
    env.set_seed(2)
    torch.manual_seed(2)  # of the actions
    frames = env.rollout(14)["next"]
    env.close()
    # Depth of a byte confirms nothing: its steps hide much, and after some walks they look like a
    # mistake, which is a known limit.
    assert not diagnose(frames, K).is_right
    speed, row = speeds_and_rows(frames)
    assert (speed[row > 0] > 1).any()
    rest = frames["raw"] - frames["ego"] - frames["obj"]
    assert rest[frames["raw_valid"].expand_as(rest)].abs().max() < 1e-3


@pytest.mark.slow_after_first
@pytest.mark.parametrize("camera", ["orbiting", "on_hand"])
def test_a_robot_that_pushes_in_panda_gym(camera):
    """tests/test_pybullet.py has the pictures' own truth."""
    pytest.importorskip("panda_gym", reason="pip install 'flowrep-rl[examples]'")
    from examples import pybullet_env

    env = pybullet_env.make_env(camera=getattr(pybullet_env, camera))
    env.set_seed(3)
    torch.manual_seed(3)  # of the random actions
    frames = env.rollout(8)["next"]
    assert diagnose(frames, env.get_wrapper_attr("K")).is_right
    moving = frames["obj"].abs().amax(-3, keepdim=True) > 0
    rows = env.get_wrapper_attr("camera").rows
    robot = {row for (body, _), row in rows.items() if body == 0}
    seen = set(frames["sensor", "instance"][moving].unique().tolist())
    env.close()
    assert seen <= robot | {rows[3, -1]}  # the object, which the robot may push
    assert seen or camera == "on_hand"


def test_a_robots_hand_in_maniskill():
    pytest.importorskip("mani_skill", reason="pip install mani_skill; Vulkan on a CPU: Mesa 25")
    from examples.maniskill_flow import make_env

    env = make_env()
    check_env_specs(env)
    env.set_seed(1)
    frames = env.rollout(15)["next"]
    env.close()
    assert diagnose(frames).is_right


def share_that_warps(frames, K):
    """The share of visible pixels of runs `[N, T]` that flow leads to their surface a frame before.

    By points, body by body, and the nearest pixel; every seventh pixel. What is nearer hides it.
    """
    agreed, visible, inverse = 0, 0, torch.as_tensor(K, dtype=torch.float32).inverse()
    for run, t in np.ndindex(len(frames), frames.shape[1] - 1):
        before, now = frames[run, t]["sensor"], frames[run, t + 1]["sensor"]
        depth, body = now["depth"][0], now["instance"][0].long()
        v, u = (x + 0.5 for x in torch.meshgrid(*map(torch.arange, body.shape), indexing="ij"))
        x, y = (torch.stack([u, v]) - frames[run, t + 1]["raw"]).floor().long()
        inside = (x >= 0) & (x < body.shape[1]) & (y >= 0) & (y < body.shape[0]) & ~depth.isinf()
        inside &= torch.arange(body.numel()).reshape(body.shape) % 7 == 0
        x, y = x.where(inside, 0), y.where(inside, 0)
        points = depth[..., None] * (torch.stack([u, v, u**0], -1) @ inverse.T)
        motion = now["instance_motion"][body]
        z = (motion[..., 2, :3] * points).sum(-1) + motion[..., 2, 3]
        there = before["depth"][0, y, x]
        seen = inside & (there > 0.97 * z)
        visible += seen.sum()
        agreed += (seen & (before["instance"][0, y, x] == body) & (there < 1.03 * z)).sum()
    assert visible > 1000
    return agreed / visible


def speeds_and_rows(frames):
    """The speed of object flow and the row of each pixel; what stands has no object flow."""
    speed, row = frames["obj"].norm(dim=-3, keepdim=True), frames["sensor", "instance"]
    assert (speed[row == 0] == 0).all()
    return speed, row


@pytest.mark.slow
def test_worlds_of_newton():
    pytest.importorskip("newton", reason="pip install newton; it runs on a CPU")
    from examples.newton_flow import K, make_env

    env = make_env()
    check_env_specs(env)
    frames = env.rollout(6, policy=lambda td: td.set("action", torch.ones(2, 1)))["next"]
    assert share_that_warps(frames, K) > 0.99
    speed, row = speeds_and_rows(frames)
    for body in (1, 2):
        assert speed[0][row[0] == body].median() < 0.9 * speed[1][row[1] == body].median()


@pytest.mark.slow
def test_a_robots_wrist_in_mjlab():
    pytest.importorskip("mjlab", reason="pip install mjlab; it runs on a CPU")
    from examples.mjlab_flow import intrinsics, make_env

    env = make_env()
    check_env_specs(env)
    frames = env.rollout(6)["next"]
    assert share_that_warps(frames, intrinsics(env)) > 0.99
    speed, row = speeds_and_rows(frames)
    assert speed[row > 0].max() > 0.5


class Bench:
    """Two benches in ManiSkill's conventions: a camera goes 0.1 m to the right above a wall 1 m
    ahead, and body 3 in front of it, in the second bench alone, as far again. K: f = 20 px."""

    def __init__(self):
        space = SimpleNamespace(low=torch.tensor([-1.0]), high=torch.tensor([1.0]))
        self.num_envs, self.device, self.single_action_space = 2, "cpu", space
        self.unwrapped, self.segmentation_id_map = self, {3: SimpleNamespace(pose=self)}
        self.steps = torch.zeros(2)

    def to_transformation_matrix(self):
        pose = torch.eye(4).repeat(2, 1, 1)
        pose[1, 0, 3] = 0.2 * self.steps[1]
        return pose

    def observe(self):
        camera, segmentation = torch.eye(4).repeat(2, 1, 1), torch.zeros(2, 6, 8, 1).short()
        camera[:, 0, 3] = 0.1 * self.steps
        segmentation[:, 2:4, 3:6] = 3
        depth = torch.full((2, 6, 8, 1), 1000, dtype=torch.int16)
        depth[:, 0, 0] = 0
        maps = {"rgb": torch.zeros(2, 6, 8, 3).byte(), "depth": depth, "segmentation": segmentation}
        K = torch.tensor([[20.0, 0, 4], [0, 20, 3], [0, 0, 1]]).repeat(2, 1, 1)
        of_camera = {"cam2world_gl": camera, "intrinsic_cv": K}
        return {"sensor_data": {"hand": maps}, "sensor_param": {"hand": of_camera}}

    def reset(self, seed=None, options=None):
        self.steps[(options or {}).get("env_idx", slice(None))] = 0
        return self.observe(), {}

    def step(self, action):
        self.steps += 1
        ended = self.steps >= torch.tensor([2.0, 9.0])
        return self.observe(), torch.ones(2), ended, torch.zeros(2, dtype=torch.bool), {}

    def close(self):
        pass


def test_maniskills_conventions_by_hand():
    env = TransformedEnv(ManiSkillEnv(Bench(), "hand"), flow_transforms())
    check_env_specs(env)
    td = env.rollout(3, break_when_any_done=False)
    after = td["next"]
    # 0.1 m to the right at 1 m and f = 20 px: all goes 2 px to the left; the body stays ahead of
    # the camera's own way by as much, so in the second bench it goes 2 px to the right.
    assert after["ego"][:, 0, 0, 5, 7].tolist() == [-2.0, -2.0]
    assert after["raw"][:, 0, 0, 2, 4].tolist() == [-2.0, 2.0]
    assert after["obj"][:, 0, 0, 2, 4].tolist() == [0.0, 4.0]
    assert after["sensor", "depth"][0, 0, 0, 0].isinf()[0]  # 0 is no surface
    assert after["done"][:, :, 0].tolist() == [[False, True, False], [False, False, False]]
    assert (td["raw"][0, 2] == 0).all()  # the first bench alone began anew
    assert td["raw"][1, 2, 0, 5, 7] == -2.0
