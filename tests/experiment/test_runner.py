"""A run that is stopped and resumed is the run that was not, and logs what happened."""

import math
import shutil

import pytest
import torch
from tensordict import TensorDict
from torch._subclasses.fake_tensor import FakeTensorMode

from flowrep.agent import CheckpointError, DivergenceError, load_checkpoint, save_checkpoint
from flowrep.config.usage import UsageError
from flowrep.experiment import build
from flowrep.experiment.run import RunFolder, RunFolderError
from flowrep.experiment.runner import Every, Means, RecentEpisodes, Runner
from flowrep.progress import StopRequest
from flowrep.train import resumed, run_in_folder
from tests.comparing import differing
from tests.config.composing import composed, plain

RUNNING, SUCCESS, COLLISION = 0, 1, 2


def step(rewards, outcomes):
    """A step of as many streets; an outcome other than 0 ends the episode."""
    after = {
        "reward": torch.tensor(rewards)[:, None],
        "outcome": torch.tensor(outcomes, dtype=torch.uint8)[:, None],
        "done": torch.tensor(outcomes)[:, None] != RUNNING,
    }
    return TensorDict({"next": after}, [len(rewards)])


STEPS = [
    step([1.0, 10.0], [RUNNING, RUNNING]),
    step([2.0, 20.0], [RUNNING, COLLISION]),  # the second street: return 30 in 2 steps
    step([4.0, 40.0], [SUCCESS, RUNNING]),  # the first: return 7 in 3
    step([8.0, 80.0], [RUNNING, SUCCESS]),  # the second's next one: return 120 in 2
]


def test_every_fires_once_for_each_multiple_that_a_jump_passes():
    every = Every(100)
    assert [step for step in range(0, 257, 32) if every(step)] == [128, 224]
    assert not any(map(Every(0), range(5)))
    assert not Every(100, last=130)(150)  # as after a resume
    assert Every(100, last=130)(201)


def test_episodes_of_each_street_are_summed_up_apart_also_across_a_checkpoint():
    recent, resumed = RecentEpisodes(), RecentEpisodes()
    assert all(math.isnan(value) for value in recent.summary().values())
    for number, each in enumerate(STEPS):
        if number == 2:
            resumed.restore(recent.state())
        recent.add(each)
        if number >= 2:
            resumed.add(each)
    summary = recent.summary()
    assert summary["success"] == pytest.approx(2 / 3)
    assert summary["collision"] == pytest.approx(1 / 3)
    assert summary["out_of_bounds"] == summary["timeout"] == 0.0
    assert summary["return"] == pytest.approx((30 + 7 + 120) / 3)
    assert summary["length"] == pytest.approx((2 + 3 + 2) / 3)
    assert resumed.summary() == summary


def test_only_the_last_hundred_episodes_count():
    recent = RecentEpisodes()
    for number in range(103):
        recent.add(step([float(number)], [SUCCESS if number < 4 else COLLISION]))
    assert recent.summary()["success"] == 0.01  # number 3 is the first of the last hundred
    assert recent.summary()["return"] == sum(range(3, 103)) / 100


def test_a_metric_is_the_mean_over_its_interval_also_across_a_checkpoint():
    means, resumed = Means(), Means()
    assert means.take() == {}
    reused = torch.tensor(0.0)  # as a CUDA graph gives the same tensor again and again
    for value in (1.0, 2.0):
        means.add({"q_loss": reused.fill_(value)})
    resumed.restore(means.state())
    for each in (means, resumed):
        each.add({"q_loss": torch.tensor(6.0)})
        assert each.take() == {"q_loss": 3.0}
        assert each.take() == {}


def test_updates_on_a_gpu_go_on_with_sums_from_a_file():
    with FakeTensorMode():  # knows CUDA's rules without a GPU
        means = Means()
        means.restore({"sums": {"q_loss": torch.tensor(1.0)}, "count": 1})
        means.add({"q_loss": torch.ones((), device="cuda")})
        assert means.state()["sums"]["q_loss"].device.type == "cuda"


def new_run(folder, *more, resume=False) -> Runner:
    config = composed(
        "debug=smoke", "num_envs=2", "total_frames=120", "checkpoint_every_frames=60",
        "log_every_frames=20", "evaluation.every_frames=0", "algorithm.precision=fp32",
        "algorithm.replay_capacity=64", "device=cpu", "seed=7", "noise=depth_camera",
        "num_workers=0", *more,
    )  # fmt: skip
    folder.mkdir(exist_ok=True)
    runner = Runner(config, RunFolder(folder))
    if resume:
        runner.load()
    return runner


def trained(runner: Runner, stop: StopRequest | None = None) -> Runner:
    runner.train(StopRequest() if stop is None else stop)
    runner.close()
    return runner


def test_the_config_says_whether_flow_is_compiled(tmp_path, monkeypatch):
    made, asked = build.env, []
    monkeypatch.setattr(build, "env", lambda *of, **with_: asked.append(with_) or made(*of))
    new_run(tmp_path, "compiled=true").close()
    assert [each["compiled"] for each in asked] == [True]


def test_a_resumed_run_keeps_its_machine_settings_unless_others_are_given(tmp_path):
    own = plain("train", "debug=smoke", "device=cpu", "num_workers=2")
    folder = RunFolder(tmp_path)
    folder.write_config(own)

    def settings(*given):
        config = resumed(composed("resume=here", *given), folder, ["resume=here", *given])
        return config.device, config.num_workers, config.total_frames

    assert settings() == ("cpu", 2, 256)
    assert settings("num_workers=0") == ("cpu", 0, 256)
    for given in ("seed=1", "algorithm.gamma=0.5", "total_frames=100"):
        with pytest.raises(UsageError, match=given.split("=")[0]):
            settings("device=cpu", given)
    assert settings("total_frames=512") == ("cpu", 2, 512)
    assert folder.read_config() == own  # until its checkpoint is read


def test_a_run_that_can_not_be_resumed_has_not_become_longer(tmp_path):
    folder = RunFolder(tmp_path)
    folder.write_config(plain("train", "debug=smoke", "device=cpu"))
    folder.checkpoint_path.parent.mkdir()
    folder.checkpoint_path.write_bytes(b"damaged")
    typed = [f"resume={tmp_path}", "total_frames=512"]
    with pytest.raises(CheckpointError):
        run_in_folder(resumed(composed(*typed), folder, typed), folder)
    assert folder.config().total_frames == 256


def test_updates_use_the_threads_of_the_config_and_all_else_one(tmp_path):
    runner = new_run(tmp_path, "threads=2")
    used, act, update = [], runner.agent.act, runner.agent.update
    runner.agent.act = lambda *of: used.append(("act", torch.get_num_threads())) or act(*of)
    runner.agent.update = lambda *of: used.append(("up", torch.get_num_threads())) or update(*of)
    trained(runner, stop_after(runner, 28))
    assert {*used} == {("act", 1), ("up", 2)}


def test_a_machine_that_emulates_the_run_s_number_format_says_so(tmp_path, monkeypatch, capsys):
    bf16 = "algorithm.precision=bf16"
    trained(new_run(tmp_path, bf16), lambda: True)
    for is_there in (True, False):
        monkeypatch.setattr("flowrep.experiment.runner.has_bf16", lambda device, i=is_there: i)
        new_run(tmp_path, bf16, resume=True).close()
        assert ("bf16" in capsys.readouterr().out) is not is_there


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that is trained to its end."""
    return trained(new_run(tmp_path_factory.mktemp("finished")))


@pytest.fixture
def copied(finished, tmp_path):
    """The folder of a copy of the finished run."""
    return shutil.copytree(finished.folder.path, tmp_path / "copied")


@pytest.mark.slow
def test_a_finished_run_is_made_longer_and_its_learning_rate_follows(finished, copied):
    assert finished.agent.updates == (120 - 16) // 10  # one for ten frames after the first batch
    assert float(logged(finished)[-1]["learning_rate"]) < 3e-4 / 5
    rows = logged(trained(new_run(copied, "total_frames=240", resume=True)))
    assert [int(row["frames"]) for row in rows] == list(range(20, 241, 20))
    assert float(rows[6]["learning_rate"]) == pytest.approx(3e-4 * 0.5, rel=0.2)
    assert float(rows[-1]["learning_rate"]) < 3e-4 / 10


def stop_after(runner: Runner, frames: int) -> StopRequest:
    class Stop(StopRequest):
        def __bool__(self) -> bool:
            return runner.frames >= frames

    return Stop()


CLOCK = {"frames_per_second", "share_outside_updates"}


def without_clock(rows):
    return [{k: v for k, v in row.items() if k not in CLOCK} for row in rows]


def logged(runner):
    return without_clock(runner.folder.read_metrics())


@pytest.mark.slow
def test_a_resumed_run_equals_the_uninterrupted_one_bit_for_bit_by_any_number_of_workers(
    finished, tmp_path, monkeypatch
):
    """From a replay memory; rollouts are in test_kills.py."""
    monkeypatch.setattr("flowrep.envs.torchrl_env.available_cores", lambda: 64)
    first = new_run(tmp_path, "num_workers=2")  # which step while updates are taken
    trained(first, stop_after(first, 50))
    monkeypatch.setattr("flowrep.envs.torchrl_env.available_cores", lambda: 1)
    second = trained(new_run(tmp_path, "num_workers=1", resume=True))
    states = (load_checkpoint(each.folder.checkpoint_path) for each in (finished, second))
    assert differing(*states) == []
    assert logged(finished) == logged(second)


@pytest.mark.slow
def test_a_checkpoint_whose_state_has_another_shape_is_one_error(copied):
    runner = new_run(copied)
    path = runner.folder.checkpoint_path
    whole = load_checkpoint(path)
    for part in ({"origin": 3}, {"frames": None}, {"agent": []}, {"memory": {}}, {"env": [1]}):
        save_checkpoint(path, whole | part)
        with pytest.raises(CheckpointError, match=r"latest\.safetensors"):
            runner.load()
    runner.close()


@pytest.mark.slow
def test_a_run_whose_checkpoint_is_gone_keeps_its_results(tmp_path):
    run = RunFolder(tmp_path)
    run.log_metrics(62, {"alpha": 0.5})  # it saves at 60
    with pytest.raises(RunFolderError, match=r"latest\.safetensors"):
        new_run(tmp_path, resume=True)
    assert len(run.read_metrics()) == 1


@pytest.mark.slow
def test_an_evaluation_that_was_cut_short_is_repeated_after_a_resume(tmp_path):
    asked = []

    class Stop(StopRequest):
        is_asked = False

        def __bool__(self):
            return self.is_asked

    class Evaluated(Runner):
        def evaluate(self, kind, stop):
            asked.append(self.frames)
            stop.is_asked = self.frames == 60 and asked.count(60) == 1
            return not stop.is_asked

    for session in range(2):
        runner = new_run(tmp_path, "evaluation.every_frames=30", resume=session > 0)
        runner.__class__ = Evaluated
        trained(runner, Stop())
    assert asked == [30, 60, 60, 90, 120]


@pytest.mark.slow
def test_a_loss_that_is_no_number_ends_the_run_before_it_is_saved(tmp_path):
    runner = new_run(tmp_path, "log_every_frames=1000")
    losses = runner.agent.losses

    def poisoned(batch):  # the eighth update is after the checkpoint at 60 frames
        factor = math.inf if runner.agent.updates == 7 else 1.0
        return losses(batch) | {"q_loss": losses(batch)["q_loss"] * factor}

    runner.agent.losses = poisoned
    with pytest.raises(DivergenceError, match=f"q_loss.*{runner.folder.checkpoint_path}"):
        runner.train(StopRequest())
    runner.close()
    resumed = new_run(tmp_path, resume=True)
    assert resumed.frames == 60
    assert trained(resumed).agent.updates == 10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "what"),
    [
        ("algorithm.learning_rate=1e9", r"nan|inf|weights too large"),
        ("representations.ego.scale=1e300", "'ego' is not finite"),
    ],
)
def test_a_run_ends_by_naming_the_map_or_loss_that_leaves_no_probabilities(tmp_path, change, what):
    more = ["total_frames=400", "log_every_frames=400", "representations=[ego]"]
    more += ["algorithm.batch_size=8", "algorithm.frames_per_update=2", change]
    runner = new_run(tmp_path, *more)
    with pytest.raises(DivergenceError, match=what):
        runner.train(StopRequest())
    assert runner.frames < 400  # before the first look at the losses
    runner.close()
