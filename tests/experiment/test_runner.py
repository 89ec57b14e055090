"""A run that is stopped and resumed is the run that was not, and logs what happened."""

import csv
import math
import shutil

import pytest
import torch
from tensordict import TensorDict
from torch._subclasses.fake_tensor import FakeTensorMode

from flowrep.agent import DivergenceError
from flowrep.config import UsageError
from flowrep.config_tree import group_choices
from flowrep.experiment.run import RunFolder, RunFolderError
from flowrep.experiment.runner import Means, RecentEpisodes, Training, train
from flowrep.progress import StopRequest
from flowrep.resuming import resumed_config
from flowrep.train import make_training
from flowrep.transforms import FlowFactorize, RawFlow
from tests.test_configs import composed

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


def test_episodes_of_each_street_are_summed_up_apart():
    recent = RecentEpisodes()
    assert all(math.isnan(value) for value in recent.summary().values())
    for each in STEPS:
        recent.add(each)
    summary = recent.summary()
    assert summary["success"] == pytest.approx(2 / 3)
    assert summary["collision"] == pytest.approx(1 / 3)
    assert summary["out_of_bounds"] == summary["timeout"] == 0.0
    assert summary["return"] == pytest.approx((30 + 7 + 120) / 3)
    assert summary["length"] == pytest.approx((2 + 3 + 2) / 3)


def test_episodes_that_run_across_a_checkpoint_are_summed_up_whole():
    before, after = RecentEpisodes(), RecentEpisodes()
    for each in STEPS[:2]:
        before.add(each)
    after.restore(before.state())
    for each in STEPS[2:]:
        before.add(each)
        after.add(each)
    assert after.summary() == before.summary()


def test_only_the_last_hundred_episodes_count():
    recent = RecentEpisodes()
    for number in range(103):
        recent.add(step([float(number)], [SUCCESS if number < 4 else COLLISION]))
    assert recent.summary()["success"] == 0.01  # number 3 is the first of the last hundred
    assert recent.summary()["return"] == sum(range(3, 103)) / 100


def test_a_metric_is_the_mean_over_its_interval_and_not_the_last_batch():
    means = Means()
    assert means.take() == {}
    reused = torch.tensor(0.0)  # as a CUDA graph gives the same tensor again and again
    for value in (1.0, 2.0, 6.0):
        means.add({"q_loss": reused.fill_(value)})
    assert means.take() == {"q_loss": 3.0}
    assert means.take() == {}
    means.add({"q_loss": torch.tensor(5.0)})
    assert means.take() == {"q_loss": 5.0}


def test_an_interval_across_a_checkpoint_has_the_mean_of_all_of_it():
    before, after = Means(), Means()
    before.add({"q_loss": torch.tensor(1.0)})
    after.restore(before.state())
    after.add({"q_loss": torch.tensor(4.0)})
    assert after.take() == {"q_loss": 2.5}
    assert before.take() == {"q_loss": 1.0}


def test_updates_on_a_gpu_go_on_with_sums_from_a_file():
    with FakeTensorMode():  # knows CUDA's rules without a GPU
        means = Means()
        means.restore({"sums": {"q_loss": torch.tensor(1.0)}, "count": 1})
        means.add({"q_loss": torch.ones((), device="cuda")})
        assert means.state()["sums"]["q_loss"].device.type == "cuda"


pytest.importorskip("pybullet", reason="training drives the simulated street")


pytestmark = pytest.mark.slow

SMALL = {"ppo": ["algorithm.rollout_length=16"]}


def new_run(
    folder, *, resume=False, algorithm="dsac", noise="none", num_workers=0
) -> tuple[Training, dict]:
    small = SMALL.get(algorithm, ["algorithm.replay_capacity=64"])
    config = composed(
        "debug=smoke", "num_envs=2", "total_frames=120", "checkpoint_every_frames=60",
        "log_every_frames=20", "evaluation.every_frames=0", "algorithm.precision=fp32",
        "device=cpu", "seed=7", f"algorithm={algorithm}", f"noise={noise}",
        f"num_workers={num_workers}", *small,
    )  # fmt: skip
    config["resume"] = str(folder) if resume else None
    return make_training(config, RunFolder(folder)), config


@pytest.mark.parametrize("compiled", [False, True])
def test_flow_is_compiled_where_the_config_says_so(tmp_path, monkeypatch, compiled):
    monkeypatch.setattr(shutil, "which", lambda name: name)
    config = composed("debug=smoke", "device=cpu", "num_workers=0", f"compiled={compiled}")
    training = make_training(config, RunFolder(tmp_path))
    flows = [t.compiled for t in training.env.transform if isinstance(t, RawFlow | FlowFactorize)]
    training.env.close()
    assert flows == [compiled, compiled]


def test_a_resumed_run_keeps_its_machine_settings_unless_others_are_given(tmp_path):
    own = composed("debug=smoke", "device=cpu", "num_workers=2")
    folder = RunFolder(tmp_path)
    folder.write_config(own)

    def resumed(*given):
        config = resumed_config(composed(*given), folder, given)
        return config["device"], config["num_workers"], config["trust"]

    assert resumed() == ("cpu", 2, None)
    assert resumed("num_workers=0", "trust=my.Class") == ("cpu", 0, "my.Class")
    folder.write_config(own | {"trust": "from.a.File"})
    assert resumed("device=auto") == ("auto", 2, None)
    with pytest.raises(UsageError, match="so 'seed=1' would be ignored"):
        resumed("device=cpu", "seed=1")


class StopAfter(StopRequest):
    """A stop that is asked for once a number of frames is reached."""

    def __init__(self, training: Training, frames: int) -> None:
        super().__init__()
        self.training, self.frames = training, frames

    def __bool__(self) -> bool:
        return self.training.frames >= self.frames


def finish(folder, *stops: int, **how) -> Training:
    """Trains in as many sessions as there are stops, and one more."""
    for stop in stops:
        training, config = new_run(folder, resume=(folder / "checkpoint").exists(), **how)
        train(training, config, StopAfter(training, stop), lambda frames: False)
        training.env.close()
    training, config = new_run(folder, resume=bool(stops), **how)
    train(training, config, StopRequest(), lambda frames: False)
    training.env.close()
    return training


def differing(a, b, place="") -> list[str]:
    """Names every leaf in which two nested states differ."""
    if isinstance(a, TensorDict):
        a, b = a.to_dict(), b.to_dict()
    if isinstance(a, dict):
        return [
            d for key in a.keys() | b.keys() for d in differing(a[key], b[key], f"{place}/{key}")
        ]
    if isinstance(a, list):
        return [
            d
            for i, pair in enumerate(zip(a, b, strict=True))
            for d in differing(*pair, f"{place}/{i}")
        ]
    same = torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
    return [] if same else [place]


@pytest.mark.parametrize("cores", [1, 64])
def test_how_many_processes_drive_is_not_seen_in_what_comes_out(tmp_path, monkeypatch, cores):
    monkeypatch.setattr("flowrep.envs.torchrl_env.available_cores", lambda: cores)
    alone = finish(tmp_path / "alone")
    training, config = new_run(tmp_path / "two", num_workers=2)
    train(training, config, StopAfter(training, 50), lambda frames: False)
    training.env.close()
    training, config = new_run(tmp_path / "two", resume=True, num_workers=1)
    train(training, config, StopRequest(), lambda frames: False)
    assert differing(alone.state(), training.state()) == []
    training.env.close()


def logged(training):
    """What metrics.csv tells of the run, but not of the clock."""
    with training.run.metrics_path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    clock = ("frames_per_second", "share_outside_updates")
    return [{k: v for k, v in row.items() if k not in clock} for row in rows]


@pytest.mark.parametrize(
    ("algorithm", "noise"),
    [*((algorithm, "none") for algorithm in group_choices("algorithm")), ("dsac", "depth_camera")],
)
def test_a_resumed_run_equals_the_uninterrupted_one_bit_for_bit(tmp_path, algorithm, noise):
    whole = finish(tmp_path / "whole", algorithm=algorithm, noise=noise)
    pieces = finish(tmp_path / "pieces", 34, 78, algorithm=algorithm, noise=noise)
    assert whole.agent.updates == pieces.agent.updates > 5
    assert differing(whole.state(), pieces.state()) == []
    assert logged(whole) == logged(pieces)
    assert len(logged(whole)) == 6


def test_a_killed_run_continues_from_its_last_checkpoint_and_drops_later_rows(tmp_path):
    training, config = new_run(tmp_path)
    saved = []

    class Killed(Exception):
        pass

    def save_once():
        if saved:
            raise Killed
        saved.append(training.frames)
        Training.save(training)

    training.save = save_once
    with pytest.raises(Killed):
        train(training, config, StopRequest(), lambda frames: False)
    training.env.close()
    resumed, config = new_run(tmp_path, resume=True)
    assert resumed.frames == saved[0] == 60
    train(resumed, config, StopRequest(), lambda frames: False)
    resumed.env.close()
    with resumed.run.metrics_path.open(newline="") as file:
        logged = [int(row["frames"]) for row in csv.DictReader(file)]
    assert logged == sorted(set(logged))
    assert logged[-1] == 120


def test_a_run_whose_checkpoint_is_gone_keeps_its_results(tmp_path):
    run = RunFolder(tmp_path)
    run.log_metrics(62, {"alpha": 0.5})  # it saves at 60
    with pytest.raises(RunFolderError, match=r"latest\.safetensors is missing.* restore that file"):
        new_run(tmp_path, resume=True)
    assert len(run.read_metrics()) == 1


def test_an_evaluation_that_was_cut_short_is_made_up_for_on_the_same_frames(tmp_path):
    class Stop(StopRequest):
        is_asked = False

        def __bool__(self):
            return self.is_asked

    asked = []

    def evaluate(frames):
        asked.append(frames)
        stop.is_asked = frames == 60 and asked.count(60) == 1
        return stop.is_asked

    for session in range(2):
        training, config = new_run(tmp_path, resume=session > 0)
        config["evaluation"]["every_frames"] = 30
        stop = Stop()
        train(training, config, stop, evaluate)
        training.env.close()
    assert asked == [30, 60, 60, 90, 120]


def test_the_loop_updates_once_for_ten_frames_after_the_first_batch(tmp_path):
    training = finish(tmp_path)
    assert training.agent.updates == (120 - 16) // 10
    assert int(float(logged(training)[-1]["updates"])) == training.agent.updates


def poison(training, updates):
    """Makes Q infinite once so many updates were taken."""
    losses = training.agent.losses

    def poisoned(batch):
        factor = math.inf if training.agent.updates == updates else 1.0
        return losses(batch) | {"q_loss": losses(batch)["q_loss"] * factor}

    training.agent.losses = poisoned


@pytest.mark.parametrize("log_every", [20, 1000])
def test_a_loss_that_is_no_number_ends_the_run_before_it_is_saved(tmp_path, log_every):
    training, config = new_run(tmp_path)
    poison(training, updates=7)  # after the checkpoint at 60 frames
    config |= {"log_every_frames": log_every}
    path = training.run.checkpoint_path
    message = rf"^q_loss became inf in update 8 \(q_loss=inf, .*entropy=.*good checkpoint is {path}"
    with pytest.raises(DivergenceError, match=message):
        train(training, config, StopRequest(), lambda frames: False)
    training.env.close()
    resumed, config = new_run(tmp_path, resume=True)
    assert resumed.frames == 60
    train(resumed, config, StopRequest(), lambda frames: False)
    resumed.env.close()
    assert resumed.agent.updates == 10


def test_a_loss_that_is_no_number_from_the_start_leaves_no_checkpoint(tmp_path):
    training, config = new_run(tmp_path)
    poison(training, updates=0)
    with pytest.raises(DivergenceError, match=r"in update 1 .*; none was saved yet"):
        train(training, config, StopAfter(training, 50), lambda frames: False)
    training.env.close()
    assert not training.run.checkpoint_path.exists()


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ("algorithm.learning_rate=1e9", r"became (nan|inf) in update|weights too large"),
        ("representations.ego.scale=1e300", r"'ego' is not finite: lower its scale"),
    ],
)
def test_a_policy_that_can_draw_no_action_ends_the_run_by_name(tmp_path, change, what):
    config = composed(
        "debug=smoke", "num_envs=2", "total_frames=400", "log_every_frames=400", "device=cpu",
        "evaluation.every_frames=0", "representations=[ego]", "algorithm.batch_size=8",
        "algorithm.frames_per_update=2", "num_workers=0", change,
    )  # fmt: skip
    training = make_training(config | {"resume": None}, RunFolder(tmp_path))
    with pytest.raises(DivergenceError, match=rf"({what}).*none was saved yet"):
        train(training, config, StopRequest(), lambda frames: False)
    assert training.frames < 400  # before the first look at the losses
    training.env.close()
