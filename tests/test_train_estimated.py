"""An agent that lives on estimated flow, from training to evaluation."""

import csv
import os
import subprocess
import sys

import pytest

pytest.importorskip("pybullet", reason="training drives the simulated street")
pytest.importorskip("cv2", reason="flow is estimated by OpenCV: pip install 'flowrep-rl[flow]'")

pytestmark = pytest.mark.slow

ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1"}
QUICK = [
    "total_frames=64", "evaluation.episodes=1", "evaluation.final_episodes=1",
    "evaluation.speeds=[normal]", "evaluation.baselines=[]", "evaluation.every_frames=64",
    "evaluation.video=false",
]  # fmt: skip


def command(*arguments, cwd):
    line = [sys.executable, "-m", *arguments]
    result = subprocess.run(line, cwd=cwd, capture_output=True, text=True, env=ENVIRONMENT)
    assert result.returncode == 0, result.stderr


def test_a_run_on_estimated_flow_is_trained_and_evaluated(tmp_path):
    run = tmp_path / "run"
    smoke = [
        "debug=smoke",
        "flow=estimated",
        "flow.preset=ultrafast",
        "motion=estimated",
        f"hydra.run.dir={run}",
    ]
    command("flowrep.train", *smoke, *QUICK, cwd=tmp_path)
    assert "motion: estimated" in (run / "config.yaml").read_text()
    asked = ["speed=high", "episodes=1", "num_envs=1", "baselines=[]", "video=1"]
    command("flowrep.evaluate", f"run={run}", *asked, cwd=tmp_path)
    with (run / "evaluation.csv").open(newline="") as file:
        assert [row["speed"] for row in csv.DictReader(file)][-1] == "high"
    assert (run / "videos" / "high_12fps_2000000.mp4").stat().st_size > 1e4


@pytest.mark.parametrize("motion", ["exact", "estimated"])
def test_a_config_says_where_the_cameras_motion_is_from(motion):
    from flowrep.experiment import build
    from flowrep.transforms import EstimateCameraMotion
    from tests.config.composing import composed

    env = build.env(composed("debug=smoke", f"motion={motion}", "num_workers=0", "device=cpu"))
    estimators = [each for each in env.transform if isinstance(each, EstimateCameraMotion)]
    env.close()
    assert len(estimators) == (motion == "estimated")


def test_the_agent_and_the_film_see_one_estimate():
    import torch

    from flowrep.envs import make_env, street_envs
    from flowrep.experiment.film import maps_of
    from flowrep.geometry import rigid_flow

    env = make_env("straight_road", ["raw", "rgb"], keep_sensor=True, seed=0, flow="estimated")
    tensordict = env.reset()
    assert not tensordict["raw"].any()  # after a reset nothing has moved
    action = torch.zeros(1, dtype=torch.long)
    for _ in range(2):
        tensordict = env.step(tensordict.set("action", action))["next"]
    K = torch.as_tensor(street_envs(env)[0].K).float()
    maps = maps_of(tensordict["sensor"][0], K)
    env.close()
    sensor = tensordict["sensor"][0]
    exact, _ = rigid_flow(sensor["depth"], sensor["instance"], K, sensor["instance_motion"])
    assert torch.equal(maps["raw"], tensordict["raw"][0])
    assert not torch.allclose(maps["raw"], exact, atol=0.1)
    known = torch.isfinite(sensor["depth"])[0]
    torch.testing.assert_close((maps["ego"] + maps["obj"])[:, known], maps["raw"][:, known])
