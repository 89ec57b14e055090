"""`flowrep.evaluate policy=...`: policies of one's own and exported agents on the benchmark."""

import csv
import json
from pathlib import Path

import pytest

pytest.importorskip("pybullet", reason="agents are evaluated in the simulated street")

from flowrep.config import UsageError
from flowrep.config.schema import EvaluateConfig, validated
from flowrep.evaluate import evaluate, evaluate_own
from flowrep.exchange.policies import PolicyError
from flowrep.export import export
from tests.config.composing import plain
from tests.test_evaluate import trained

pytestmark = pytest.mark.slow

SMALL = ["scene.camera.height_px=24", "scene.camera.width_px=24"]
QUICK = ["speed=normal", "num_workers=0", "num_envs=2", "device=cpu", "scene=straight_road"]


def own(name, output, *overrides):
    config = plain("evaluate", f"output={output}", f"policy='{name}'", *QUICK, *overrides)
    evaluate_own(validated(EvaluateConfig, config).plain(), [name])
    with (output / "evaluation.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def episodes(rows, policy):
    return [{**row, "policy": ""} for row in rows if row["policy"] == policy]


def successes(rows):
    return sum(row["outcome"] == "success" for row in rows)


def test_a_policy_that_goes_on_drives_as_the_baseline_does(tmp_path):
    path = tmp_path / "straight.py"
    path.write_text("def make(task):\n    return lambda maps: [0] * len(maps)\n")
    name = f"{path}:make"
    given = ["representations=[seg]", "episodes=3", "baselines=[never_turn]"]
    rows = own(name, tmp_path / "out", *given)
    assert len(episodes(rows, name)) == 3
    assert episodes(rows, name) == episodes(rows, "never_turn")
    assert {(row["representations"], row["frames"]) for row in rows} == {("seg", "0")}
    with pytest.raises(UsageError, match=r"'straight_road' has scene\.time_limit_steps=200, and "):
        own(name, tmp_path / "out", *given, "scene.time_limit_steps=3")


def test_rows_of_other_maps_are_not_mixed_with_those_of_the_first(tmp_path):
    path = tmp_path / "straight.py"
    path.write_text("def make(task):\n    return lambda maps: [0] * len(maps)\n")
    given = ["representations=[seg,depth]", "episodes=1", "baselines=[]", *SMALL]
    own(f"{path}:make", tmp_path / "out", *given)
    assert len(own(f"{path}:make", tmp_path / "out", *given, "episodes=2")) == 2
    for change, said in (
        ("noise=depth_camera", r"have noise\.\w+='absent', and rows with 0\.\d+ would be"),
        ("representations=[depth]", r"have representations\.seg=.*: give these another folder"),
    ):
        with pytest.raises(UsageError, match=said):
            own(f"{path}:make", tmp_path / "out", *given, change)
    path.rename(tmp_path / "other.py")  # another policy's rows are known by its name
    rows = own(f"{tmp_path}/other.py:make", tmp_path / "out", *given, "representations=[depth]")
    assert [row["representations"] for row in rows] == ["seg+depth", "seg+depth", "depth"]


def test_the_documented_example_beats_never_turning_and_is_filmed(tmp_path):
    given = [
        "representations=[obj,depth]",
        "episodes=12",
        "num_envs=12",
        "baselines=[never_turn]",
        *SMALL,
        "video=1",
    ]
    rows = own("examples/own_policy.py:make", tmp_path, *given)
    mine = episodes(rows, "examples/own_policy.py:make")
    assert len(mine) == 12
    assert successes(mine) > 2 * successes(episodes(rows, "never_turn"))
    films = [path.name for path in (tmp_path / "videos").iterdir()]
    assert films == ["straight_road_normal_12fps_2000000.mp4"]


def test_an_agent_of_stable_baselines3_drives(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3", reason="the agent is Stable-Baselines3's")
    from examples.stable_baselines3_ppo import train

    name = f"{Path('examples/stable_baselines3_ppo.py').resolve()}:make"
    monkeypatch.chdir(tmp_path)
    train(8, num_envs=2, rollout_length=4).save("ppo_street")
    given = ["representations=[ego,obj]", "episodes=2", "baselines=[]"]
    rows = own(name, tmp_path / "out", *given)
    assert len(episodes(rows, name)) == 2


def test_an_exported_agent_drives_as_it_did_in_flowrep(tmp_path):
    given = ["algorithm.precision=fp32", "representations=[ego,obj]"]
    run = trained(tmp_path / "run", *given)
    quick = ["speed=normal", "num_workers=0", "num_envs=2", "device=cpu"]
    asked = plain("evaluate", f"run={run.path}", *quick, "episodes=3", "baselines=[]")
    evaluate(validated(EvaluateConfig, asked).plain(), [run])
    mine = episodes(run.read_episodes(), "greedy")
    folder = export(run)
    assert folder == run.path / "export"
    card = json.loads((folder / "agent.json").read_text())
    assert [(each["name"], each["shape"]) for each in card["maps"]] == [
        ("ego", [2, 40, 48]),
        ("obj", [2, 40, 48]),
    ]
    for number, name in enumerate([f"{folder}/load_agent.py:make", f"{folder}/agent.pt2"]):
        # the scene with the camera that the agent was trained with
        camera = [f"scene.camera.{key}={value}" for key, value in camera_of(run).items()]
        options = [*given[1:], *camera, "episodes=3", "baselines=[]"]
        with pytest.raises(PolicyError, match=r"; give scene\.camera\.height_px=40 scene"):
            own(name, tmp_path / "refused", *given[1:])
        rows = own(name, tmp_path / str(number), *options)
        drives = [(row["episode_seed"], row["outcome"], row["return"]) for row in rows]
        assert drives == [(row["episode_seed"], row["outcome"], row["return"]) for row in mine]


def camera_of(run):
    camera = run.read_config()["scene"]["camera"]
    return {key: camera[key] for key in ("height_px", "width_px", "fov_deg")}


def test_a_policy_without_actions_leaves_a_line_and_no_row(tmp_path, capsys):
    path = tmp_path / "mine.py"
    path.write_text("def make(task):\n    return lambda maps: None\n")
    with pytest.raises(PolicyError, match="returned a NoneType; expected 1 whole numbers"):
        own(f"{path}:make", tmp_path / "out", "representations=[seg]", "num_envs=1", "episodes=1")
    assert not (tmp_path / "out" / "videos").exists()
    assert capsys.readouterr().out == ""  # no table of no episodes, in a file that isn't there
