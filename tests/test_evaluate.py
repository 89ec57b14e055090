"""`flowrep.evaluate` on runs of a few frames: what it runs, what it refuses, what it keeps."""

import csv
import json
import os
import re
import shutil
import signal

import pytest
import torch
import yaml

pytest.importorskip("pybullet", reason="agents are evaluated in the simulated street")

from flowrep.agent import CheckpointError
from flowrep.baselines import Drive
from flowrep.config import UsageError
from flowrep.config.schema import EvaluateConfig, validated, validated_run
from flowrep.envs import WorkerError, make_env, street_envs
from flowrep.evaluate import evaluate, runs_in
from flowrep.experiment.env_pool import EnvPool
from flowrep.experiment.evaluation import Episode
from flowrep.experiment.run import RunFolder, RunFolderError
from flowrep.experiment.runner import Runner
from flowrep.export import export
from flowrep.progress import StopRequest
from flowrep.subjects import Subject, load_subject
from flowrep.tables import TableError
from flowrep.viz.curves import _evaluated
from flowrep.viz.film import film_episode
from tests.config.composing import composed, plain

pytestmark = pytest.mark.slow

QUICK = ["speed=normal", "episodes=2", "num_envs=2", "num_workers=0", "baselines=[]", "device=cpu"]


def trained(path, *overrides):
    """A run of 64 frames, its checkpoint saved."""
    config = composed(
        "debug=smoke", "total_frames=64", "device=cpu", "evaluation.every_frames=1000", *overrides
    )
    run = RunFolder(path)
    run.write_config(config.plain())
    runner = Runner(config, run)
    runner.train(StopRequest())
    runner.close()
    return run


def asked(run, *overrides):
    config = plain("evaluate", f"run={run.path}", *QUICK, *overrides)
    return validated(EvaluateConfig, config).plain()


def rows_of(run):
    with run.evaluation_path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    sweep = tmp_path_factory.mktemp("runs")
    return trained(sweep / "dsac", "evaluation.final_episodes=2", "representations=[obj]")


@pytest.fixture
def untouched(run):
    """The run, whose table and config are put back afterwards."""
    config = (run.path / "config.yaml").read_bytes()
    yield run
    (run.path / "config.yaml").write_bytes(config)
    run.evaluation_path.unlink(missing_ok=True)
    shutil.rmtree(run.path / "scenes", ignore_errors=True)


def test_a_run_of_ppo_is_evaluated_whatever_its_batch(tmp_path):
    whole_rollout = ["algorithm.rollout_length=16", "algorithm.batch_size=64"]
    run = trained(tmp_path / "ppo", "algorithm=ppo", *whole_rollout)
    evaluate(asked(run, "policy=[greedy,sampled]"), [run])
    assert [row["policy"] for row in rows_of(run)] == ["greedy"] * 2 + ["sampled"] * 2


def test_what_was_asked_for_is_neither_a_final_evaluation_nor_in_the_learning_curve(untouched):
    run = untouched
    evaluate(asked(run, "policy=[greedy,sampled]", "fps=[6,12]"), [run])
    assert {row["evaluation"] for row in rows_of(run)} == {"evaluate"}
    assert _evaluated(run) == []


def test_evaluated_again_the_table_is_the_same_byte_for_byte(untouched):
    run = untouched
    evaluate(asked(run, "policy=sampled", "speed=[low,high]", "baselines=[random]"), [run])
    before = run.evaluation_path.read_bytes()
    evaluate(asked(run, "policy=sampled", "speed=[low,high]", "baselines=[random]"), [run])
    assert run.evaluation_path.read_bytes() == before
    evaluate(asked(run, "policy=sampled", "speed=high", "num_envs=5"), [run])
    assert run.evaluation_path.read_bytes() == before


def test_the_runs_of_a_sweep_are_evaluated_together_on_the_same_episodes(untouched):
    run = untouched
    other = RunFolder(run.path.parent / "other")
    shutil.copytree(run.path, other.path, dirs_exist_ok=True)
    sweep = RunFolder.all_in(run.path.parent)
    assert [each.path.name for each in sweep] == ["dsac", "other"]
    try:
        evaluate(asked(run, "baselines=[random]"), sweep)
        assert rows_of(other) == rows_of(run)
        assert len(rows_of(run)) == 4
    finally:
        shutil.rmtree(other.path)


def test_a_run_that_is_named_twice_is_evaluated_once(run, tmp_path):
    (tmp_path / "link").symlink_to(run.path)
    named = [run.path, run.path.parent, tmp_path / "link", f"{run.path}/../{run.path.name}"]
    assert [each.path for each in runs_in(named)] == [run.path]


def test_an_agent_drives_in_another_scene_when_that_is_asked_for(untouched):
    run = untouched
    evaluate(asked(run, "scene=s_turn", "baselines=[never_turn]"), [run])
    assert {row["scene"] for row in rows_of(run)} == {"s_turn"}
    assert len(rows_of(run)) == 4


def test_a_changed_scene_needs_a_name_of_its_own(run):
    with pytest.raises(UsageError, match=r"has scene\.time_limit_steps=200, .* rows with 3 would"):
        load_subject(asked(run, "scene=straight_road", "scene.time_limit_steps=3"), run)
    changed = "scene=straight_road", "scene.time_limit_steps=3", "scene.name=short"
    for scene in (changed, changed[:1]):  # the latter is its own
        load_subject(asked(run, *scene), run)


def test_two_changed_scenes_of_one_name_are_told_apart(untouched):
    run, short = untouched, ["scene=straight_road", "scene.name=short"]
    evaluate(asked(run, *short, "scene.time_limit_steps=3"), [run])
    table = run.evaluation_path.read_bytes()
    evaluate(asked(run, *short, "scene.time_limit_steps=3"), [run])
    assert run.evaluation_path.read_bytes() == table
    with pytest.raises(UsageError, match=r"'short' has scene\.time_limit_steps=3, and .* 4 would"):
        load_subject(asked(run, *short, "scene.time_limit_steps=4"), run)

    kept = run.path / "scenes/short.yaml"
    kept.write_text("[]")
    with pytest.raises(RunFolderError, match=r"short\.yaml is not what was .* rows of 'short'"):
        load_subject(asked(run, *short, "scene.time_limit_steps=3"), run)
    run.evaluation_path.unlink()  # without rows nothing can be mistaken
    kept.write_bytes(b"\xff")
    evaluate(asked(run, *short, "scene.time_limit_steps=4"), [run])
    assert yaml.safe_load(kept.read_text())["time_limit_steps"] == 4


def test_an_agent_that_reads_classes_is_told_that_another_scene_has_others(tmp_path):
    run = trained(tmp_path / "seg", "representations=[seg]")
    with pytest.raises(CheckpointError, match="can't look at scene 's_turn', which has other clas"):
        evaluate(asked(run, "scene=s_turn"), [run])


def test_an_edited_config_is_refused(untouched):
    run = untouched
    path = run.path / "config.yaml"
    path.write_text(path.read_text().replace("straight_road", "s_turn"))
    with pytest.raises(CheckpointError, match=r"scene\.name=straight_road, .* scene\.name=s_turn"):
        evaluate(asked(run), [run])


def offsets_in(data):
    """Where a checkpoint can be damaged: its header, and inside the largest tensor of each part."""
    start = 8 + int.from_bytes(data[:8], "little")
    tensors = json.loads(data[8:start])
    del tensors["__metadata__"]
    spans = {name: tensor["data_offsets"] for name, tensor in tensors.items()}
    largest = {}
    for name in sorted(spans, key=lambda name: spans[name][1] - spans[name][0]):
        largest[name.split("/")[1]] = start + sum(spans[name]) // 2
    return {"length": 1, "header": 8 + start // 2, "end": len(data) - 1} | largest


READERS = {
    "evaluate": lambda run: evaluate(asked(run), [run]),
    "export": export,
    "resume": lambda run: Runner(validated_run(run.read_config(), "config.yaml"), run).load(),
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_a_byte_that_was_changed_anywhere_in_a_checkpoint_is_refused_by_name(run, read, tmp_path):
    damaged = RunFolder(shutil.copytree(run.path, tmp_path / "damaged"))
    data = run.checkpoint_path.read_bytes()
    offsets = offsets_in(data)
    assert offsets.keys() >= {"observation", "policy", "agent", "memory", "torch_rng"}
    for place, offset in offsets.items():
        flipped = bytes([data[offset] ^ 0x10])
        damaged.checkpoint_path.write_bytes(data[:offset] + flipped + data[offset + 1 :])
        says = f"{re.escape(str(damaged.checkpoint_path))} is not a readable checkpoint"
        with pytest.raises(CheckpointError, match=says):
            pytest.fail(f"{place}: {read(damaged)}")


def test_a_damaged_table_is_refused_before_an_episode_is_run(untouched, monkeypatch):
    run = untouched
    run.evaluation_path.write_text("scene;fps\nstraight_road;12\n")
    monkeypatch.setattr("flowrep.evaluate.compare", lambda *_: pytest.fail("too late"))
    with pytest.raises(TableError, match="lacks"):
        evaluate(asked(run), [run])


class SomeArena:
    """Runs nothing: an episode's return is its frame rate. `look` is called after each ride."""

    def __init__(self, order=1, look=lambda: None):
        self.order, self.look = order, look

    def run(self, jobs):
        for number, job in list(enumerate(jobs))[:: self.order]:
            yield number, Episode(job.episode_seed, "success", "", job.fps, 5)
            self.look()

    def drive(self, jobs):
        for number, (_, options) in enumerate(jobs):
            yield number, Drive(options["episode_seed"], "timeout", "", -5.0, 7)

    def close(self):
        pass


@pytest.fixture
def some(tmp_path, monkeypatch):
    """Makes runs whose agents drive in an arena, by default `SomeArena`."""

    def make(*names, arena=None):
        def load(asked, run):
            if not run.path.name.startswith("good"):
                raise CheckpointError(f"no checkpoint in {run.path}")
            return Subject(run, config, None, 64, run.read_episodes())

        config = composed("representations=[obj]", "scene=s_turn")
        monkeypatch.setattr("flowrep.evaluate.load_subject", load)
        monkeypatch.setattr("flowrep.experiment.build.arena", lambda *_: arena or SomeArena())
        return [RunFolder(tmp_path / name) for name in names]

    return make


def test_what_is_complete_is_saved_before_the_rest_is_run(some):
    (run,) = some("good", arena=SomeArena(look=lambda: saved.append(len(run.read_episodes()))))
    saved = []
    evaluate(asked(run, "fps=[12,6]", "baselines=[random]"), [run])
    assert saved == [0, 2, 2, 4]
    assert len(rows_of(run)) == 8


def test_the_order_in_which_episodes_end_is_not_seen_in_the_table(some):
    many = "fps=[12,6]", "speed=[low,high]", "policy=[greedy,sampled]", "baselines=[random]"
    (run,) = some("good")
    evaluate(asked(run, *many), [run])
    (backwards,) = some("good_backwards", arena=SomeArena(order=-1))
    evaluate(asked(backwards, *many), [backwards])
    assert backwards.evaluation_path.read_bytes() == run.evaluation_path.read_bytes()


def test_a_run_that_can_not_be_saved_costs_no_other_its_episodes(some, capsys):
    runs = some("good_1", "good_2")
    (runs[0].path / "evaluation.tmp").mkdir()
    with pytest.raises(SystemExit) as ended:
        evaluate(asked(runs[0]), runs)
    assert ended.value.code == 1
    assert len(rows_of(runs[1])) == 2
    said = capsys.readouterr()
    assert f"error: {runs[0].path}: " in said.err
    assert f"2 episodes are in {runs[1].evaluation_path}" in said.out


def test_a_run_that_can_not_be_evaluated_is_named_and_the_others_are(some, capsys):
    runs = some("bad_1", "good", "bad_2")
    with pytest.raises(SystemExit) as ended:
        evaluate(asked(runs[0]), runs)
    assert ended.value.code == 1
    assert len(rows_of(runs[1])) == 2
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if line.startswith("error")] == [
        f"error: no checkpoint in {runs[0].path}",
        f"error: no checkpoint in {runs[2].path}",
        f"error: not evaluated or not saved, see above: {runs[0].path}, {runs[2].path}",
    ]
    with pytest.raises(CheckpointError, match="bad_2"):
        evaluate(asked(runs[0]), [runs[0], runs[2]])


def test_a_run_that_is_in_use_is_named_and_the_others_are_evaluated(some, capsys):
    runs = some("good_1", "good_2")
    with runs[0].held("training"), pytest.raises(SystemExit) as ended:
        evaluate(asked(runs[0]), runs)
    assert ended.value.code == 1
    assert len(rows_of(runs[1])) == 2
    said = capsys.readouterr().err
    assert f"error: '{runs[0].path}' is in use: process {os.getpid()} on" in said
    with runs[1].held("evaluating"):  # its lock is free again
        pass


def test_a_worker_that_dies_is_one_line_and_what_was_run_is_kept(untouched, monkeypatch):
    run = untouched

    def dies(self, jobs):
        yield from ()
        raise WorkerError("the worker process of environment 0 is gone (SIGKILL)")

    monkeypatch.setattr(EnvPool, "drive", dies)
    with pytest.raises(WorkerError):
        evaluate(asked(run, "baselines=[random]"), [run])
    assert [row["policy"] for row in rows_of(run)] == ["greedy"] * 2


def test_ctrl_c_keeps_what_was_run_and_says_so_to_the_shell(untouched, monkeypatch):
    run = untouched

    def interrupted(self, jobs):
        os.kill(os.getpid(), signal.SIGINT)
        yield 0, Drive(2_000_000, "timeout", "", -5.0, 7)

    monkeypatch.setattr(EnvPool, "drive", interrupted)
    with pytest.raises(SystemExit) as ended:
        evaluate(asked(run, "baselines=[random]", "video=1"), [run])
    assert ended.value.code == 130
    assert [row["policy"] for row in rows_of(run)] == ["greedy", "greedy", "random"]
    assert not (run.path / "videos").exists()


def test_a_stop_ends_between_two_films(untouched, monkeypatch):
    filmed = []

    def record(make, policy, seen, path, episode_seed):
        filmed.append(path.name)
        signal.raise_signal(signal.SIGTERM)  # as schedulers send it

    monkeypatch.setattr("flowrep.evaluate.record_episode", record)
    with pytest.raises(SystemExit) as ended:
        evaluate(asked(untouched, "video=2", "seed=7"), [untouched])
    assert ended.value.code == 128 + signal.SIGTERM
    assert filmed == ["normal_12fps_7.mp4"]


def test_a_film_is_of_the_episode_that_names_it():
    env = make_env("straight_road", {"rgb": {}}, keep_sensor=True)

    def leave_the_road(tensordict):
        return tensordict.set("action", torch.ones(1, dtype=torch.int64))

    film_episode(env, leave_the_road, episode_seed=2_000_017)
    assert street_envs(env)[0].episode.seed == 2_000_017
    env.close()
