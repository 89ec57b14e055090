"""What an agent that lives on estimated flow is given."""

import pytest
import torch

pytest.importorskip("pybullet", reason="training drives the simulated street")
pytest.importorskip("cv2", reason="flow is estimated by OpenCV: pip install 'flowrep-rl[flow]'")

from flowrep.baselines import BaselinePolicy
from flowrep.envs import make_env, street_envs
from flowrep.experiment import build
from flowrep.geometry import ego_flow, rigid_flow
from flowrep.transforms import EstimateCameraMotion
from tests.config.composing import composed

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("motion", ["exact", "estimated"])
def test_with_the_camera_compensated_what_stands_still_has_hardly_any_object_flow(motion):
    options = ["preset=laptop", "flow=estimated", f"motion={motion}", "representations=[ego,obj]"]
    options += ["num_envs=2", "num_workers=0", "device=cpu"]
    env = build.env(composed(*options), keep_sensor=True, seed=0)
    estimators = [each for each in env.transform if isinstance(each, EstimateCameraMotion)]
    assert len(estimators) == (motion == "estimated")
    planner, streets = BaselinePolicy("planner"), torch.arange(2)
    planner.enter(env)
    frames = env.rollout(24, lambda td: planner(td.set("env_id", streets)))["next"]
    K, sensor = torch.as_tensor(street_envs(env)[0].K).float(), frames["sensor"]
    env.close()
    depth, ids, motions = (sensor[key] for key in ("depth", "instance", "instance_motion"))
    exact = (rigid_flow(depth, ids, K, motions).flow - frames["ego"]).norm(dim=-3, keepdim=True)
    moved = frames["obj"].norm(dim=-3, keepdim=True)
    static = (ids == 0) & depth.isfinite()
    assert (moved[static] > 1.0).float().mean() < 0.01  # 0.1 without
    assert moved[exact > 0.5].median() > 0.5


@pytest.mark.parametrize("picture_scale", [1, 2])
def test_the_agent_is_given_an_estimate_of_pictures_of_that_size(picture_scale):
    flow = {"source": "estimated", "picture_scale": picture_scale}
    env = make_env(
        "straight_road", ["raw", "rgb", "ego"], keep_sensor=True, seed=0, flow=flow,
        motion="estimated",
    )  # fmt: skip
    tensordict = env.reset()
    assert not tensordict["raw"].any()  # after a reset nothing has moved
    action = torch.zeros(1, dtype=torch.long)
    for _ in range(2):
        tensordict = env.step(tensordict.set("action", action))["next"]
    K = torch.as_tensor(street_envs(env)[0].K).float()
    env.close()
    raw, sensor = tensordict["raw"][0], tensordict["sensor"][0]
    assert tensordict["rgb"].shape[-1] == picture_scale * raw.shape[-1]
    exact, _ = rigid_flow(sensor["depth"], sensor["instance"], K, sensor["instance_motion"])
    assert not torch.allclose(raw, exact, atol=0.1)
    ego = ego_flow(sensor["depth"], K, sensor["estimated_motion"]).flow
    torch.testing.assert_close(tensordict["ego"][0], ego, atol=1e-5, rtol=0)
