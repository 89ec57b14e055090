"""Flow in a PyBullet env that others wrote; tests/test_pybullet.py has the pictures' own truth."""

import pytest
import torch

pytest.importorskip("panda_gym", reason="pip install 'flowrep-rl[examples]'")

from examples.pybullet_env import make_env, on_hand, orbiting
from flowrep import diagnose


@pytest.mark.slow_after_first
@pytest.mark.parametrize("camera", [orbiting, on_hand])
def test_each_frame_warps_into_the_one_before(camera):
    env = make_env(camera=camera)
    env.set_seed(3)
    torch.manual_seed(3)  # of the random actions
    frames = env.rollout(8)["next"]
    assert diagnose(frames, env.get_wrapper_attr("K")).is_right
    moving = frames["obj"].abs().amax(-3, keepdim=True) > 0
    rows = env.get_wrapper_attr("camera").rows
    robot = [row for (body, _), row in rows.items() if body == 0]
    seen = set(frames["sensor", "instance"][moving].unique().tolist())
    env.close()
    assert seen <= set(robot) | {rows[3, -1]}  # the object, which the robot may push
    if camera is orbiting:
        assert seen
