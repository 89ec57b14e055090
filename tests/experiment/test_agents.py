"""Agents from Python: trained, evaluated, saved and loaded, and those that come with flowrep."""

import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from flowrep.agent import CheckpointError, save_checkpoint
from flowrep.config import group_choices
from flowrep.config.usage import UsageError
from flowrep.experiment.agents import Agent
from flowrep.experiment.policies import PRETRAINED
from flowrep.experiment.run import RunFolder
from tests.comparing import differing
from tests.config.composing import composed

SCENES = sorted(group_choices("scene"))

TINY = {
    "scene": "s_turn", "representations": ["obj"], "debug": "smoke", "total_frames": 128,
    "evaluation": {"every_frames": 0}, "device": "cpu", "scene.time_limit_steps": 30,
    "algorithm.hidden_size": 16,
}  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """An agent of a few frames, the folder of its run, and the rows that were logged."""
    folder, rows = tmp_path_factory.mktemp("runs") / "first", []
    return Agent.train(folder=folder, callback=rows.append, **TINY), folder, rows


def test_an_agent_is_trained_by_the_runner_of_the_command(trained):
    agent, folder, rows = trained
    assert [row["frames"] for row in rows] == [64, 128]
    assert {*rows[0]} >= {"success", "q_loss", "updates"}
    run = RunFolder.existing(folder)
    assert [int(row["frames"]) for row in run.read_metrics()] == [64, 128]
    assert run.config() == agent.config
    precision = agent.config.algorithm.precision
    assert precision != "auto"
    assert agent.config == composed(
        "scene=s_turn", "representations=[obj]", "debug=smoke", "total_frames=128",
        "evaluation.every_frames=0", "device=cpu", "scene.time_limit_steps=30",
        "algorithm.hidden_size=16", f"algorithm.precision={precision}",
    )  # fmt: skip


def test_an_agent_is_the_same_from_its_run_and_from_a_file(trained, tmp_path):
    agent, folder, _ = trained
    agent.save(tmp_path / "agent.safetensors")
    episodes = agent.evaluate(episodes=2)
    assert [(each.episode_seed, each.scene, each.frames, each.policy) for each in episodes] == [
        (seed, "s_turn", 128, "greedy") for seed in (2_000_000, 2_000_001)
    ]
    (tmp_path / "12:00").symlink_to(folder)  # a colon, as in module:make
    for name in (folder, tmp_path / "12:00", tmp_path / "agent.safetensors"):
        again = Agent.load(name, device="cpu")
        assert differing(again.policy.state_dict(), agent.policy.state_dict()) == []
        assert (again.frames, again.trained_in) == (128, agent.config.scene)
    assert again.evaluate(episodes=2) == episodes


def test_what_is_saved_is_the_config_of_the_training_not_of_another_scene(trained, tmp_path):
    agent, folder, _ = trained
    elsewhere = Agent.load(folder, scene="straight_road", device="cpu")
    elsewhere.save(tmp_path / "agent.safetensors")
    again = Agent.load(tmp_path / "agent.safetensors", device="cpu")
    assert again.config.scene == agent.config.scene != elsewhere.config.scene
    Agent(agent.policy, agent.config, 5).save(tmp_path / "by_hand.safetensors")
    assert Agent.load(tmp_path / "by_hand.safetensors", device="cpu").frames == 5


def test_a_small_file_rounds_weights_to_a_byte(trained, tmp_path):
    agent, whole, small = trained[0], tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    agent.save(whole)
    agent.save(small, small=True)
    assert small.stat().st_size < 0.5 * whole.stat().st_size
    rounded = Agent.load(small, device="cpu").policy.state_dict()
    for name, weight in agent.policy.state_dict().items():
        atol = weight.abs().max() / 254 + 1e-6
        torch.testing.assert_close(rounded[name], weight, rtol=0, atol=atol)


def test_baselines_drive_the_same_episodes(trained):
    agent, _, _ = trained
    records = agent.evaluate(1, speeds=["low", "high"], fps=[6], seed=3, baselines=["never_turn"])
    assert [(each.speed, each.fps, each.policy, each.episode_seed) for each in records] == [
        (speed, 6.0, policy, 3) for speed in ("low", "high") for policy in ("greedy", "never_turn")
    ]
    never_turn = Agent.load("never_turn", scene=agent.config.scene)
    (alone,) = never_turn.evaluate(1, speeds=["low"], fps=[6], seed=3)
    assert (alone.outcome, alone.length) == (records[1].outcome, records[1].length)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"speed": "fast"}, "speed"),
        ({"sceen": "s_turn"}, "sceen"),
        ({"scene": "t_turn"}, "t_turn'; there are: s_turn, .*three_way_junction"),
        ({"experiment": "smok"}, "unknown experiment 'smok'"),
        ({"debug": "smok"}, "unknown debug 'smok'"),
        ({"algorithm.tua": 0.1}, "algorithm.tua"),
        ({"resume": "outputs/first"}, "resume="),
        ({"representations": None}, "group"),
        ({"total_frames": np.int64(128)}, "total_frames"),
    ],
)
def test_a_wrong_key_or_value_is_named_before_a_folder_is_made(tmp_path, given, named):
    with pytest.raises(UsageError, match=named):
        Agent.train(folder=tmp_path / "run", preset="laptop", **given)
    assert not (tmp_path / "run").exists()


def test_ctrl_c_saves_the_run_and_is_raised_and_the_program_keeps_its_threads(tmp_path):
    def interrupt(row):
        signal.raise_signal(signal.SIGINT)

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with pytest.raises(KeyboardInterrupt, match=str(tmp_path)):
            Agent.train(folder=tmp_path / "run", callback=interrupt, **TINY)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert Agent.load(tmp_path / "run", device="cpu").frames == 64  # the first row is at 64


def test_the_folder_of_another_run_is_refused(trained):
    _, folder, _ = trained
    with pytest.raises(ValueError, match="holds a run already"):
        Agent.train(folder=folder, debug="smoke")


def test_a_run_that_can_not_be_built_does_not_take_its_folder(tmp_path):
    with pytest.raises(ValueError, match="8"):  # too small a picture for the encoder
        Agent.train(folder=tmp_path / "run", **TINY, **{"scene.camera.height_px": 8})
    RunFolder(tmp_path / "run").check_is_new()


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"episodes": 0}, "episodes"),
        ({"speeds": "low"}, "speeds"),
        ({"fps": np.array([6, 12])}, "fps"),
        ({"policies": ["best"]}, "policies"),
        ({"policies": ["sampled"]}, "policies"),  # it has no probabilities to draw from
        ({"baselines": ["plan"]}, "baselines"),
    ],
)
def test_an_impossible_evaluation_is_refused_by_its_key(given, named):
    agent = Agent.load("never_turn", scene="s_turn")
    with pytest.raises(UsageError, match=rf"^{named}\b"):
        agent.evaluate(**{"episodes": 1, **given})


@pytest.mark.parametrize(
    ("name", "given", "named"),
    [
        # what a baseline or an agent of flowrep's would ignore
        ("planner", {"flow": {"source": "exact"}}, "flow="),
        ("planner", {"precision": "fp32"}, "precision="),
        ("pretrained", {"scene": "s_turn", "motion": "exact"}, "motion="),
        ("pretrained", {"scene": "s_turn", "representations": ["ego"]}, "representations="),
        ("planner", {"representations": {"rgb": None}}, "representations="),
        ("pretrained", {"scene": "s_turn", "num_envs": 0}, "num_envs"),
        ("pretrained", {"scene": "s_turn", "num_workers": "many"}, "num_workers"),
        ("pretrained", {"scene": "s_turn", "device": "gpu"}, "device"),
        ("missing:make", {"scene": "s_turn"}, "representations"),
        ("missing:make", {"representations": "ego"}, r"\['ego'\]"),
        ("missing:make", {"representations": ["eog"]}, "eog"),
        ("missing:make", {"representations": ["ego"], "motion": "extact"}, "motion"),
        ("missing.safetensors", {}, "missing.safetensors"),
        ("12:00.safetensors", {}, "12:00.safetensors"),  # a colon, as in module:make
    ],
)
def test_a_wrong_policy_or_keyword_is_refused_by_its_name(name, given, named):
    with pytest.raises((UsageError, CheckpointError), match=named):
        Agent.load(name, **given)


def test_names_of_maps_stand_for_their_options_in_conf(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text("make = lambda task: lambda maps: [len(task.representations)] * len(maps)")
    agent = Agent.load(f"{script}:make", scene="s_turn", representations=["ego", "obj"])
    assert agent.config.representations == composed("representations=[ego,obj]").representations


@pytest.mark.parametrize("change", [{"policy": [1]}, {"policy": {"a": "b"}}, {"frames": "many"}])
def test_a_checkpoint_of_something_else_is_no_agent(trained, tmp_path, change):
    path = tmp_path / "other.safetensors"
    state = {"config": trained[0].config.plain(), "frames": 1, "policy": {}}
    save_checkpoint(path, state | change)
    with pytest.raises(CheckpointError, match=path.name):
        Agent.load(path)
    save_checkpoint(path, {"frames": 1})
    with pytest.raises(CheckpointError, match="config"):
        Agent.load(path)


def test_no_agent_is_saved_without_weights_or_under_a_name_that_load_refuses(trained, tmp_path):
    for path in (tmp_path, tmp_path / "agent"):
        with pytest.raises(UsageError, match=r"\.safetensors"):
            trained[0].save(path)
    with pytest.raises(UsageError, match="weights"):
        Agent.load("never_turn", scene="s_turn").save(tmp_path / "x.safetensors")
    assert [*tmp_path.iterdir()] == []


def test_a_baseline_that_is_given_workers_drives_without_them():
    agent = Agent.load("never_turn", scene="straight_road", num_workers=1)
    assert len(agent.evaluate(2)) == 2


# The agents that come with flowrep: that they load, see what they were trained on, and drive.


def test_every_scene_has_a_pretrained_agent_of_at_most_three_megabytes():
    sizes = {path.stem: path.stat().st_size for path in PRETRAINED.glob("*.safetensors")}
    assert sorted(sizes) == SCENES
    assert max(sizes.values()) <= 3_000_000  # 1.7 MB for two maps of 60 × 60, 2.6 MB for three


@pytest.mark.parametrize("scene", [pytest.param(s, marks=pytest.mark.slow) for s in SCENES])
def test_a_pretrained_agent_drives_where_never_turning_fails(scene):
    episodes = Agent.load("pretrained", scene=scene, device="cpu").evaluate(10, seed=0)
    # one that never turns drives Straight Road in one of ten episodes, the other scenes never
    assert sum(each.outcome == "success" for each in episodes) >= 8


def test_a_saved_agent_computes_in_the_faster_format_of_this_machine(monkeypatch):
    monkeypatch.setattr("flowrep.agent.precision.has_bf16", lambda device: False)
    agent = Agent.load("pretrained", scene="straight_road", device="cpu")
    assert agent.config.algorithm.precision == "fp32"  # it was trained in bf16


def test_a_scene_with_changes_is_driven_with_the_camera_of_training(straight_road):
    scene = replace(straight_road, time_limit_steps=7)
    driven = Agent.load("pretrained", scene=scene, device="cpu").config.scene
    assert (scene.camera.height_px, driven.camera.height_px) == (84, 60)
    assert driven.time_limit_steps == 7


def test_an_agent_acts_with_its_mirror_image_if_asked_to_and_where_the_street_is_its_own(tmp_path):
    config = TINY | {"evaluation": {"every_frames": 0, "mirror": True}, "scene": "straight_road"}
    agent = Agent.train(folder=tmp_path / "run", **config)
    agent.save(path := tmp_path / "agent.safetensors")
    for each in (agent, Agent.load(path), Agent.load(tmp_path / "run")):
        assert each.policy[0].module.mirror.swapped_actions.tolist() == [0, 2, 1]
        assert differing(each.policy.state_dict(), agent.policy.state_dict()) == []
    assert Agent.load(path, scene="s_turn").policy[0].module.mirror is None


def test_a_trained_agent_meets_noise_that_its_training_lacked(close_later):
    agent = Agent.load("pretrained", scene="s_turn", device="cpu", noise={"depth_dropout": 0.3})
    seen = close_later(agent.make_env(num_envs=1, keep_sensor=True)).reset()
    assert seen["sensor", "depth"].isnan().sum() == 0
    assert 0.27 < seen["sensor", "noisy_depth"].isnan().double().mean() < 0.33


def test_a_scene_without_a_pretrained_agent_names_those_that_have_one(straight_road):
    with pytest.raises(UsageError, match="s_turn"):
        Agent.load("pretrained", scene=replace(straight_road, name="my_street"))
