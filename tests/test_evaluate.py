"""`flowrep.evaluate` on runs of a few frames: what it runs, what it refuses, what it keeps."""

import csv

import pytest
from omegaconf import OmegaConf

pytest.importorskip("pybullet", reason="agents are evaluated in the simulated street")

from flowrep.agent import CheckpointError
from flowrep.evaluate import evaluate
from flowrep.experiment.figures import _evaluated
from flowrep.experiment.interruption import StopRequest
from flowrep.experiment.run_folder import RunFolder
from flowrep.experiment.tables import TableError
from flowrep.experiment.training import train
from flowrep.train import build
from tests.test_configs import composed

QUICK = ["speed=normal", "episodes=2", "num_envs=2", "num_workers=0", "baselines=[]", "device=cpu"]


def trained(path, *overrides):
    """A run of 64 frames, its checkpoint saved."""
    config = composed(
        "debug=smoke", "total_frames=64", "device=cpu", "evaluation.every_frames=1000", *overrides
    )
    run = RunFolder(path)
    run.write_config(config)
    training = build(config, run)
    train(training, config, StopRequest(), lambda frames: False)
    training.env.close()
    return run


def asked(run, *overrides):
    return OmegaConf.create(composed(f"run={run.path}", *QUICK, *overrides, name="evaluate"))


def rows_of(run):
    with run.evaluation_path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("runs") / "dsac", "evaluation.final_episodes=2")


@pytest.fixture
def untouched(run):
    """The run, whose table and config are put back afterwards."""
    config = (run.path / "config.yaml").read_bytes()
    yield run
    (run.path / "config.yaml").write_bytes(config)
    run.evaluation_path.unlink(missing_ok=True)


def test_a_run_of_ppo_is_evaluated_whatever_its_batch(tmp_path):
    whole_rollout = ["algorithm.rollout_length=16", "algorithm.batch_size=64"]
    run = trained(tmp_path / "ppo", "algorithm=ppo", *whole_rollout)
    evaluate(asked(run, "policy=[greedy,sampled]"), run)
    assert [row["policy"] for row in rows_of(run)] == ["greedy"] * 2 + ["sampled"] * 2


def test_what_was_asked_for_is_neither_a_final_evaluation_nor_in_the_learning_curve(untouched):
    run = untouched
    evaluate(asked(run, "policy=[greedy,sampled]", "fps=[6,12]"), run)
    assert {row["evaluation"] for row in rows_of(run)} == {"evaluate"}
    assert not run.is_evaluated(64, 2)
    assert _evaluated(run) == []


def test_an_edited_config_is_refused(untouched):
    run = untouched
    path = run.path / "config.yaml"
    path.write_text(path.read_text().replace("straight_road", "s_turn"))
    with pytest.raises(CheckpointError, match=r"scene\.name=straight_road, .* scene\.name=s_turn"):
        evaluate(asked(run), run)


def test_a_damaged_table_is_refused_before_an_episode_is_run(untouched, monkeypatch):
    run = untouched
    run.evaluation_path.write_text("scene;fps\nstraight_road;12\n")
    monkeypatch.setattr("flowrep.evaluate.compare", lambda *_, **__: pytest.fail("too late"))
    with pytest.raises(TableError, match="lacks the columns"):
        evaluate(asked(run), run)
