"""What a command prints to go on with works when it is pasted, whatever the folder's name."""

import shlex

import pytest
from hydra.core.global_hydra import GlobalHydra

pytest.importorskip("pybullet", reason="the commands need the simulator")

from flowrep import evaluate, train
from flowrep.config.command_line import line_for
from flowrep.experiment.run import RunFolder
from tests.config.composing import plain

NAMES = ["plain", "a=b,[c] {d}", 'José\'s "runs"', "日本 ~1#", "${seed}", "2026", "back\\slash\\"]


@pytest.fixture(params=NAMES)
def folder(request, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = RunFolder(tmp_path / request.param)
    folder.write_config(plain("train", "debug=smoke", "seed=7"))
    yield folder
    GlobalHydra.instance().clear()


def run_line(line, main, monkeypatch):
    words = shlex.split(line)
    assert words[:2] == ["python", "-m"]
    monkeypatch.setattr("sys.argv", words[2:])
    main()


@pytest.mark.slow_after_first
def test_a_run_continues(folder, monkeypatch):
    opened = []
    monkeypatch.setattr(train, "carry_out", lambda config, run: opened.append((config, run)))
    line = train.how_to_resume({"algorithm": {"_target_": "flowrep.agent.DiscreteSAC"}}, folder)
    run_line(line, train.main, monkeypatch)
    ((config, run),) = opened
    assert (run.path, config["seed"]) == (folder.path, 7)
    assert config["resume"] == str(folder.path)


@pytest.mark.slow
def test_a_run_is_evaluated(folder, monkeypatch):
    opened = []
    monkeypatch.setattr(evaluate, "evaluate", lambda config, runs: opened.extend(runs))
    run_line(line_for("evaluate", run=str(folder.path)), evaluate.main, monkeypatch)
    assert [run.path for run in opened] == [folder.path]


@pytest.mark.slow
def test_a_name_typed_without_hydras_quotes_is_understood(folder, monkeypatch):
    opened = []
    monkeypatch.setattr(evaluate, "evaluate", lambda config, runs: opened.extend(runs))
    monkeypatch.setattr("sys.argv", ["evaluate", f"run={folder.path.name}"])
    evaluate.main()
    assert [run.path.resolve() for run in opened] == [folder.path.resolve()]


def test_an_algorithm_of_one_s_own_is_vouched_for_again(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/usr/bin/flowrep-train"])
    config = {"algorithm": {"_target_": "mine.Learner"}}
    line = train.how_to_resume(config, RunFolder(tmp_path / "run"))
    assert line == f"flowrep-train resume={tmp_path}/run trust=mine.Learner"
