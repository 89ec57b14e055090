"""The agents that come with flowrep: that they load, see what they were trained on, and drive."""

import pytest
import torch

pytest.importorskip("pybullet", reason="agents drive in the simulated street")

from flowrep import pretrained
from flowrep.config import UsageError, group_choices
from flowrep.experiment.evaluation import evaluate

SCENES = sorted(group_choices("scene"))
# of 20 episodes; one that never turns drives Straight Road in one of ten, the other scenes never
LEAST = {"straight_road": 12, "s_turn": 12, "h_shaped_pathways": 3, "three_way_junction": 18}


def successes(agent, episodes):
    env = agent.make_env(num_envs=episodes)
    found = list(evaluate(env, agent.policy, [{"episode_seed": k} for k in range(episodes)]))
    env.close()
    return sum(episode.outcome == "success" for episode in found)


def test_every_scene_has_one_of_at_most_a_megabyte():
    sizes = {path.stem: path.stat().st_size for path in pretrained.FOLDER.glob("*.safetensors")}
    assert sorted(sizes) == SCENES
    assert max(sizes.values()) <= 1_000_000


def test_rows_keep_their_largest_weight_exactly_and_others_to_half_a_step():
    weights = {
        "filters": torch.tensor([[[2.54, -0.013]], [[0.0, 0.0]]]),
        "bias": torch.tensor([0.3]),
    }
    found = pretrained.unpacked(pretrained.packed(weights))
    # a step of the first row is 2.54 / 127 = 0.02: -0.013 becomes -0.02, by truncation it were 0
    torch.testing.assert_close(
        found["filters"], torch.tensor([[[2.54, -0.02]], [[0.0, 0.0]]]), rtol=0, atol=1e-6
    )
    assert torch.equal(found["bias"], weights["bias"])


@pytest.mark.parametrize("scene", [pytest.param(s, marks=pytest.mark.slow) for s in SCENES])
def test_it_drives_where_one_that_never_turns_does_not(scene):
    assert successes(pretrained.load(scene, device="cpu"), 20) >= LEAST[scene]


def test_a_scene_with_changes_is_driven_with_the_camera_of_training():
    whole = pretrained.load("straight_road", device="cpu").config.scene
    scene = {**whole, "time_limit_steps": 7, "camera": {**whole["camera"], "height_px": 84}}
    agent = pretrained.load(scene, device="cpu")
    assert agent.config.scene["time_limit_steps"] == 7
    assert agent.config.scene["camera"]["height_px"] == 48


def test_a_scene_without_one_is_told_which_there_are():
    with pytest.raises(UsageError, match="straight_road"):
        pretrained.load("my_street")
