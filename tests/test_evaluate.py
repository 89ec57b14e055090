"""`flowrep.evaluate` on agents of a few frames: what it runs, what it refuses, what it keeps."""

import multiprocessing
import os
import signal
from contextlib import closing, nullcontext
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from examples import export_agent, share_agent
from flowrep.agent import CheckpointError
from flowrep.baselines import BaselinePolicy
from flowrep.config.usage import UsageError
from flowrep.envs import WorkerError
from flowrep.evaluate import candidates_of
from flowrep.evaluate import run as evaluate
from flowrep.experiment import build
from flowrep.experiment.agents import Agent
from flowrep.experiment.evaluation import PairedEvaluation
from flowrep.experiment.policies import PolicyError
from flowrep.experiment.run import RunFolder, RunFolderError
from flowrep.experiment.runner import Runner
from flowrep.files import TableError
from tests.config.composing import composed, config_of
from tests.running import run_here

pytestmark = pytest.mark.slow

QUICK = ["speed=normal", "num_envs=2", "num_workers=0", "device=cpu"]
SHORT = "scene.time_limit_steps=40"
SMALL = ["scene.camera.height_px=24", "scene.camera.width_px=24"]


def saved(path, *overrides):
    """A run that saved its checkpoint before the first frame; its episodes are short."""
    config = build.resolved(composed("debug=smoke", "device=cpu", SHORT, *overrides))
    folder = RunFolder(path)
    runner = Runner(config, folder)
    folder.write_config(config.plain())
    runner.observation = runner.env.reset()
    runner.save()
    runner.close()
    return folder


def asked(*overrides):
    return config_of("evaluate", "episodes=2", "baselines=[]", *QUICK, *overrides)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("runs") / "dsac", "representations=[obj]")


@pytest.fixture
def untouched(run):
    """The run, whose table and config are put back afterwards."""
    config = (run.path / "config.yaml").read_bytes()
    yield run
    (run.path / "config.yaml").write_bytes(config)
    run.evaluation_path.unlink(missing_ok=True)


def test_an_agent_drives_at_the_frame_rate_of_its_scene_unless_another_is_given(tmp_path):
    folder = saved(tmp_path / "slow", "representations=[obj]", "scene.frame_rate_hz=10")
    evaluate(asked(f"run={folder.path}"))
    evaluate(asked(f"run={folder.path}", "fps=12"))
    rows = [(row["fps"], row["evaluation"]) for row in folder.read_episodes()]
    assert rows == [("10.0", "evaluate")] * 2 + [("12.0", "evaluate")] * 2


def test_a_run_that_is_named_twice_is_evaluated_once(run, tmp_path):
    (tmp_path / "link").symlink_to(run.path)
    named = [run.path, run.path.parent, tmp_path / "link", f"{run.path}/../{run.path.name}"]
    config = asked("run=x").model_copy(update={"run": [str(path) for path in named]})
    assert [candidate.folder.path for candidate in candidates_of(config)] == [run.path]


def test_an_agent_drives_in_another_scene_and_changed_scenes_are_told_apart(untouched):
    here = f"run={untouched.path}"
    evaluate(asked(here, "scene=s_turn", "baselines=[never_turn]"))
    assert [row["scene"] for row in untouched.read_episodes()] == ["s_turn"] * 4
    evaluate(asked(here, "scene=straight_road", "scene.time_limit_steps=3"))
    evaluate(asked(here, "scene=straight_road", "scene.time_limit_steps=4"))
    rows = untouched.read_episodes()[4:]
    assert [row["scene"] for row in rows] == ["straight_road"] * 4
    assert len({row["scene_id"] for row in rows}) == 2
    assert {row["length"] for row in rows} == {"3", "4"}


@pytest.mark.parametrize("typed", ["flowrep.evaluate run", "flowrep.view policy"])
def test_a_camera_that_was_typed_for_an_agent_that_keeps_its_own_is_refused(
    typed, run, monkeypatch, capsys
):
    # The scene's height differs, too, but was not typed.
    line = f"python {typed}={run.path} scene=s_turn ++scene.camera.width_px=18"
    assert run_here(monkeypatch, line.split()) == 2
    assert "error: scene.camera.width_px=18: " in capsys.readouterr().err


def test_an_agent_that_reads_classes_drives_wherever_it_knows_them_all(tmp_path):
    folder = saved(tmp_path / "seg", "representations=[seg]")
    with pytest.raises(CheckpointError, match=r"never saw terrain of scene 's_turn'"):
        evaluate(asked(f"run={folder.path}", "scene=s_turn"))
    for name, *classes in (("s_turn", "scene=s_turn"), ("all", "scene.categories=all")):
        folder = saved(tmp_path / name, "representations=[seg]", *classes)
        other = "straight_road" if name == "s_turn" else "three_way_junction"
        evaluate(asked(f"run={folder.path}", f"scene={other}", "baselines=[]"))
        assert {row["scene"] for row in folder.read_episodes()} == {other}


def test_an_edited_config_is_refused(untouched):
    path = untouched.path / "config.yaml"
    path.write_text(path.read_text().replace("straight_road", "s_turn"))
    with pytest.raises(CheckpointError, match=r"scene\.name=straight_road"):
        evaluate(asked(f"run={untouched.path}"))


def test_a_damaged_table_is_refused_before_an_episode_is_run(untouched, monkeypatch):
    untouched.evaluation_path.write_text("scene;fps\nstraight_road;12\n")
    monkeypatch.setattr(PairedEvaluation, "run", lambda *_, **__: pytest.fail("too late"))
    with pytest.raises(TableError, match=r"evaluation\.csv"):
        evaluate(asked(f"run={untouched.path}"))


# Agents that go straight on, in folders of which the good ones can be evaluated.


def turn_left(tensordict):
    return tensordict.set("action", torch.ones(tensordict.batch_size, dtype=torch.int64))


@pytest.fixture
def driver():
    """Drives straight on; before its step number `at` it does something else."""

    def driver(tensordict):
        driver.steps += 1
        if driver.steps == driver.at:
            driver.act()
        return tensordict.set("action", torch.zeros(tensordict.batch_size, dtype=torch.int64))

    driver.steps = driver.at = 0
    return driver


@pytest.fixture
def some(tmp_path, monkeypatch, driver):
    """Makes runs, and the config that evaluates them."""
    tiny = ["representations=[obj]", "scene.camera.height_px=12", "scene.camera.width_px=20", SHORT]
    config = composed(*tiny, "device=cpu")

    def load(path, *, scene=None, trusted=(), **machine):
        if not path.name.startswith("good"):
            raise CheckpointError(f"no checkpoint in {path}")
        drives = turn_left if path.name == "good_left" else driver
        return Agent(drives, config.model_copy(update=machine), 64, config.scene)

    def make(*names, overrides=()):
        monkeypatch.setattr(Agent, "load", load)
        folders = [RunFolder(tmp_path / name) for name in names]
        for folder in folders:
            folder.write_config({})
        paths = {"run": [str(folder.path) for folder in folders]}
        return folders, asked("run=x", *overrides).model_copy(update=paths)

    return make


def test_the_runs_of_a_sweep_are_evaluated_beside_the_same_episodes_of_baselines(some, monkeypatch):
    drivers, enter = [], BaselinePolicy.enter
    monkeypatch.setattr(
        BaselinePolicy, "enter", lambda self, env: drivers.append(self.name) or enter(self, env)
    )
    folders, config = some("good", "good_left", overrides=["baselines=[random]"])
    evaluate(config)
    ours, theirs = (folder.read_episodes() for folder in folders)
    assert [row["policy"] for row in ours] == ["greedy"] * 2 + ["random"] * 2
    assert [a == b for a, b in zip(ours, theirs, strict=True)] == [False] * 2 + [True] * 2
    assert drivers == ["random"]  # once for both


@pytest.mark.parametrize("trouble", ["it can not be saved", "it is in use"])
def test_a_run_in_trouble_costs_no_other_its_episodes(some, capsys, trouble):
    folders, config = some("good_1", "good_2")
    in_use = folders[0].locked() if trouble == "it is in use" else nullcontext()
    if trouble == "it can not be saved":
        (folders[0].path / "evaluation.csv").mkdir()
    with in_use, pytest.raises(SystemExit) as ended:
        evaluate(config)
    assert ended.value.code == 1
    assert len(folders[1].read_episodes()) == 2
    said = capsys.readouterr()
    errors = [line for line in said.err.splitlines() if line.startswith("error: ")]
    assert errors
    assert all(str(folders[0].path) in line for line in errors)
    assert str(folders[1].evaluation_path) in said.out
    with folders[1].locked():  # its lock is free again
        pass


def test_a_run_that_can_not_be_evaluated_is_named_and_the_others_are(some, capsys):
    folders, config = some("bad_1", "good", "bad_2")
    with pytest.raises(SystemExit) as ended:
        evaluate(config)
    assert ended.value.code == 1
    assert len(folders[1].read_episodes()) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert [str(folder.path) in said[-1] for folder in folders] == [True, False, True]
    _, config = some("bad_3")
    with pytest.raises(CheckpointError, match="bad_3"):
        evaluate(config)


@pytest.fixture
def workers():
    """Returns the ids of the processes that step envs."""
    others = {*multiprocessing.active_children()}
    return lambda: [each.pid for each in {*multiprocessing.active_children()} - others]


MANY = ["speed=[low,high]", "episodes=8", "num_envs=4", "baselines=[never_turn]"]
ONE_GROUP_ENDED = 130  # 8 episodes of at most 40 steps, 4 at a time; some of the second, too


def of_low_speed(rows):
    """The greedy episodes at low speed, the first group that is run."""
    return [row for row in rows if (row["speed"], row["policy"]) == ("low", "greedy")]


@pytest.mark.parametrize(("number", "num_workers"), [(signal.SIGINT, 0), (signal.SIGTERM, 2)])
def test_an_evaluation_that_was_stopped_keeps_whole_groups_and_leaves_no_trace_once_run_again(
    some, driver, workers, number, num_workers
):
    (whole, folder), config = some("good_1", "good_2", overrides=MANY)
    evaluate(config.model_copy(update={"run": [str(whole.path)]}))
    rows = whole.read_episodes()
    assert len(rows) == 32

    def signal_all():  # as terminals and schedulers do
        assert len(workers()) == num_workers
        for process in (*workers(), os.getpid()):
            os.kill(process, number)

    driver.at, driver.act = driver.steps + ONE_GROUP_ENDED, signal_all
    again = config.model_copy(update={"run": [str(folder.path)]})
    with pytest.raises(SystemExit) as ended:
        evaluate(again.model_copy(update={"num_workers": num_workers}))
    assert ended.value.code == 128 + number
    assert folder.read_episodes() == of_low_speed(rows)
    evaluate(again)
    assert folder.evaluation_path.read_bytes() == whole.evaluation_path.read_bytes()


def test_a_worker_that_is_killed_is_named_and_what_ended_before_is_kept(some, driver, workers):
    (folder,), config = some("good", overrides=MANY)
    saved = []

    def kill():
        saved.append(len(folder.read_episodes()))
        os.kill(workers()[0], signal.SIGKILL)

    driver.at, driver.act = ONE_GROUP_ENDED, kill
    with pytest.raises(WorkerError, match=r"environments \d to \d is gone \(exit code -9\)"):
        evaluate(config.model_copy(update={"num_workers": 2}))
    rows = folder.read_episodes()
    assert saved == [8]  # before the next group ended
    assert len(rows) == 8
    assert rows == of_low_speed(rows)


# Policies of the user's own, and exported agents.


def own(name, output, *overrides):
    evaluate(asked(f"policy={name}", f"output={output}", "scene=straight_road", *overrides))
    return RunFolder(output).read_episodes()


def episodes(rows, policy):
    return [{**row, "policy": ""} for row in rows if row["policy"] == policy]


def test_the_documented_example_beats_never_turning(tmp_path):
    given = ["representations=[obj,depth]", "episodes=12", "num_envs=12", *SMALL]
    rows = own("examples/own_policy.py:make", tmp_path, "baselines=[never_turn]", *given)
    mine = episodes(rows, "examples/own_policy.py:make")
    assert len(mine) == 12
    assert {(r["representations"], r["frames"], r["seed"]) for r in mine} == {
        ("obj+depth", "0", "")
    }
    ends = ([row["outcome"] for row in of] for of in (mine, episodes(rows, "never_turn")))
    reached, by_chance = (of.count("success") for of in ends)
    assert reached > 2 * by_chance


def test_an_agent_of_stable_baselines3_drives(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3", reason="the agent is Stable-Baselines3's")
    from examples.stable_baselines3_ppo import train

    name = f"{Path('examples/stable_baselines3_ppo.py').resolve()}:make"
    monkeypatch.chdir(tmp_path)
    train(8, num_envs=2, rollout_length=4).save("ppo_street")
    rows = own(name, tmp_path / "out", "representations=[ego,obj]", "episodes=1")
    assert len(episodes(rows, name)) == 1


def test_an_agent_in_a_file_drives_as_in_its_run(untouched, tmp_path):
    Agent.load(untouched.path, device="cpu").save(tmp_path / "agent.safetensors")
    name = str(tmp_path / "agent.safetensors")
    rows = own(name, tmp_path / "out", SHORT, "episodes=3")
    evaluate(asked(f"run={untouched.path}", "scene=straight_road", SHORT, "episodes=3"))
    mine = episodes(untouched.read_episodes(), "greedy")
    assert episodes(rows, name) == mine


def test_an_agent_that_the_example_exports_drives_as_it_did_in_flowrep(tmp_path):
    run = saved(tmp_path / "run", "algorithm.precision=fp32", "representations=[ego,obj]")
    evaluate(asked(f"run={run.path}", "episodes=3"))
    mine = episodes(run.read_episodes(), "greedy")
    program = str(tmp_path / "agent.pt2")
    names = export_agent.export(run.path, program)
    camera = run.read_config()["scene"]["camera"]
    same = [f"scene.camera.{key}={camera[key]}" for key in ("height_px", "width_px", "fov_deg")]
    maps = f"representations=[{','.join(names)}]"
    script = tmp_path / "exported.py"
    script.write_text(f"from examples.export_agent import load\nmake = lambda _: load({program!r})")
    rows = own(f"{script}:make", tmp_path / "out", maps, *same, "episodes=3", SHORT)
    driven = [(row["episode_seed"], row["outcome"], row["return"]) for row in rows]
    assert driven == [(row["episode_seed"], row["outcome"], row["return"]) for row in mine]
    agent, act = Agent.load(run.path, precision="fp32", device="cpu"), export_agent.load(program)
    with closing(agent.make_env(num_envs=3, num_workers=0)) as env:
        seen = env.rollout(4)[:, -1]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(act(seen), agent.policy(seen)["action"])


def test_an_agent_packed_for_a_hub_is_the_runs_beside_a_card_of_its_episodes(untouched, tmp_path):
    evaluate(asked(f"run={untouched.path}", "speed=[low,high]"))
    share_agent.pack(untouched.path, tmp_path / "shared")
    card = (tmp_path / "shared" / "README.md").read_text("utf-8")
    rows = [line.split(" | ") for line in card.splitlines() if line.startswith("| straight_road")]
    assert [row[2:6] for row in rows] == [["greedy", x, "12.0", "2"] for x in ("low", "high")]
    assert "# straight_road: obj, 0 frames" in card
    shared = Agent.load(tmp_path / "shared" / "agent.safetensors", device="cpu").policy
    mine = Agent.load(untouched.path, device="cpu").policy
    assert all(map(torch.equal, shared.parameters(), mine.parameters()))


def test_a_policy_without_actions_leaves_a_line_and_no_row(tmp_path, capsys):
    path = tmp_path / "mine.py"
    path.write_text("def make(task):\n    return lambda maps: None\n")
    with pytest.raises(PolicyError, match="None"):
        own(f"{path}:make", tmp_path / "out", "representations=[seg]", "num_envs=1", "episodes=1")
    assert not (tmp_path / "out" / "videos").exists()
    assert capsys.readouterr().out == ""  # no table of no episodes, in a file that isn't there


def test_episodes_of_a_policy_are_not_replaced_by_those_with_other_maps(tmp_path):
    (tmp_path / "mine.py").write_text("def make(_):\n    return lambda maps: [0] * len(maps)\n")
    name, first = f"{tmp_path}/mine.py:make", ["representations=[obj,depth]", SHORT, *SMALL]
    rows = own(name, tmp_path / "out", *first)
    turned = "representations=[depth,obj]"
    for other in ("noise=depth_camera", turned):
        with pytest.raises(RunFolderError, match=r"output="):
            own(name, tmp_path / "out", *first, other)
        (tmp_path / "out" / "maps.yaml").unlink(missing_ok=True)  # as in an older version's folder
    # Episodes of another scene are others; those of the first are still there.
    more = own(name, tmp_path / "out", *first, "scene.time_limit_steps=3", turned)
    assert (more[:2], len(more)) == (rows, 4)


def test_rows_of_another_policy_are_refused_in_a_runs_folder(run):
    with pytest.raises(UsageError, match="output"):
        own("examples/own_policy.py:make", run.path, "representations=[seg]")
