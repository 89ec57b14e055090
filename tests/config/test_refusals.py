"""What can't be is refused by name, in one line, before anything is built."""

import pytest

pytest.importorskip("pybullet", reason="the schema reads the simulator's names")

from flowrep.config import UsageError, validated
from flowrep.config.evaluating import EvaluateConfig
from flowrep.config.training import TrainConfig, validated_run
from flowrep.config.viewing import ViewConfig
from tests.config.composing import plain


def refusal(command, schema, line):
    with pytest.raises(UsageError) as caught:
        validated(schema, plain(command, *line.split()))
    return str(caught.value)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("algorithm.gamma=2", "algorithm.gamma should be a number from 0 to 1, not 2"),
        ("algorithm.gamma=-1", "algorithm.gamma should be a number from 0 to 1, not -1"),
        ("algorithm.gamma=true", "algorithm.gamma should be a number from 0 to 1, not true"),
        ("algorithm.gamma=nan", "algorithm.gamma should be a number from 0 to 1, not nan"),
        ("algorithm.n_steps=0", "algorithm.n_steps should be a positive whole number, not 0"),
        ("algorithm.layer_norm=1", "algorithm.layer_norm should be true or false, not 1"),
        ("algorithm.tau=0", "algorithm.tau should be a number above 0 and up to 1, not 0"),
        ("algorithm.tau=5", "algorithm.tau should be a number above 0 and up to 1, not 5"),
        ("algorithm.learning_rate=0", "algorithm.learning_rate should be a number above 0, not 0"),
        (
            "algorithm.learning_rate=inf",
            "algorithm.learning_rate should be a number above 0, not inf",
        ),
        (
            "algorithm.learning_rate=abc",
            "algorithm.learning_rate should be a number above 0, not 'abc'",
        ),
        (
            "algorithm.learning_rate=null",
            "algorithm.learning_rate should be a number above 0, not null",
        ),
        (
            "algorithm.frames_per_update=-1",
            "algorithm.frames_per_update should be a positive whole number, not -1",
        ),
        (
            "algorithm.frames_per_update=0",
            "algorithm.frames_per_update should be a positive whole number, not 0",
        ),
        (
            "algorithm.target_entropy_weight=50",
            "algorithm.target_entropy_weight should be a number from 0 to 1, not 50",
        ),
        (
            "algorithm.initial_alpha=-1",
            "algorithm.initial_alpha should be a number above 0, not -1",
        ),
        (
            "algorithm.hidden_size=0",
            "algorithm.hidden_size should be a positive whole number, not 0",
        ),
        (
            "algorithm.batch_size=-1",
            "algorithm.batch_size should be a positive whole number, not -1",
        ),
        (
            "algorithm.batch_size=1.5",
            "algorithm.batch_size should be a positive whole number, not 1.5",
        ),
        (
            "algorithm=dqn algorithm.initial_epsilon=3",
            "algorithm.initial_epsilon should be a number from 0 to 1, not 3",
        ),
        (
            "algorithm=ppo algorithm.epochs=0",
            "algorithm.epochs should be a positive whole number, not 0",
        ),
        (
            "algorithm=ppo algorithm.clip=-1",
            "algorithm.clip should be a number above 0 and up to 1, not -1",
        ),
        (
            "algorithm=ppo algorithm.gae_lambda=3",
            "algorithm.gae_lambda should be a number from 0 to 1, not 3",
        ),
        (
            "algorithm=ppo algorithm.rollout_length=1.5",
            "algorithm.rollout_length should be a positive whole number, not 1.5",
        ),
        (
            "evaluation.every_frames=-1",
            "evaluation.every_frames should be a whole number from 0, not -1",
        ),
        (
            "evaluation.every_frames=nan",
            "evaluation.every_frames should be a whole number from 0, not nan",
        ),
        (
            "evaluation.every_frames=1.5",
            "evaluation.every_frames should be a whole number from 0, not 1.5",
        ),
        (
            "evaluation.every_frames=null",
            "evaluation.every_frames should be a whole number from 0, not null",
        ),
        (
            "evaluation.speeds=[]",
            "evaluation.speeds should be a list of one or more different values, each low, normal "
            "or high, not []",
        ),
        (
            "evaluation.speeds=normal",
            "evaluation.speeds should be a list of one or more different values, each low, normal "
            "or high, not 'normal'; write evaluation.speeds=[normal]",
        ),
        (
            "evaluation.speeds=[low,hgih]",
            "evaluation.speeds should be a list of one or more different values, each low, normal "
            "or high, not ['low', 'hgih'] (did you mean 'high'?)",
        ),
        (
            "evaluation.speeds=[low,low]",
            "evaluation.speeds should be a list of one or more different values, each low, normal "
            "or high, not ['low', 'low']",
        ),
        (
            "evaluation.fps=[12,0.1]",
            "evaluation.fps should be a list of one or more different values, each a number from "
            "0.5 to 1000, not [12, 0.1]",
        ),
        ("evaluation.video=maybe", "evaluation.video should be true or false, not 'maybe'"),
        (
            "speed=norml",
            "speed should be low, normal or high, not 'norml' (did you mean 'normal'?)",
        ),
        ("total_frames=true", "total_frames should be a positive whole number, not true"),
        (
            "total_frames=2e6",
            "total_frames should be a positive whole number, not 2000000.0; write 2000000",
        ),
        ("seed=-1", "seed should be a whole number from 0 to 2147483647, not -1"),
        ("device=meta", "device should be auto, cpu, cuda or cuda:<number>, not 'meta'"),
        ("num_workers=-1", "num_workers should be a whole number from 0, or auto, not -1"),
        ("wandb=true", "wandb should be off, offline or online, not true"),
        (
            "representations.ego.scale=nan",
            "representations.ego.scale should be a number other than 0, not nan",
        ),
        (
            "evaluation=null",
            "evaluation should be a section with the keys every_frames, episodes, final_episodes, "
            "speeds, fps, baselines, video, not null",
        ),
        ("representations=[]", "'representations' needs a value: representations=[ego,obj]"),
        ("~seed", "'seed' needs a value: seed=0"),
        ("~algorithm.gamma", "'algorithm.gamma' needs a value: algorithm.gamma=..."),
        ("total_frames=???", "'total_frames' needs a value: total_frames=..."),
    ],
)
def test_a_value_that_can_not_be_is_named_with_what_could(line, expected):
    assert refusal("train", TrainConfig, line) == expected


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (
            "algorithm.batch_size=20000",
            "algorithm.replay_capacity should hold at least batch_size=20000, 20000 transitions, "
            "not 10240; raise it or lower the other",
        ),
        (
            "algorithm.replay_capacity=63 algorithm.batch_size=40",
            "algorithm.replay_capacity should hold at least 2 steps of num_envs=32, 64 "
            "transitions, not 63; raise it or lower the other",
        ),
        (
            "algorithm.n_steps=3 algorithm.replay_capacity=127 algorithm.batch_size=40",
            "algorithm.replay_capacity should hold at least 4 steps of num_envs=32, 128 "
            "transitions, not 127; raise it or lower the other",
        ),
        (
            "total_frames=5000 algorithm.learning_starts=4991",
            "algorithm.learning_starts is 4991, so the first update would come after 5001 frames, "
            "but total_frames is 5000: nothing would be learnt",
        ),
        (
            "algorithm.batch_size=31",
            "algorithm.batch_size should be at least num_envs=32, not 31: before their second step "
            "there is nothing to learn from; raise learning_starts or lower num_envs",
        ),
        (
            "algorithm=dqn algorithm.initial_epsilon=0.1 algorithm.final_epsilon=0.2",
            "algorithm.final_epsilon should be at most initial_epsilon=0.1, not 0.2",
        ),
        (
            "algorithm=ppo algorithm.rollout_length=7",
            "algorithm.batch_size should be at most the 224 frames of a rollout (7 steps of "
            "32 envs), not 256: lower it, or raise rollout_length or num_envs",
        ),
        (
            "algorithm=ppo total_frames=2047",
            "algorithm.rollout_length makes the 2048 frames of a rollout (64 steps of 32 "
            "envs), but total_frames is 2047: nothing would be learnt",
        ),
        ("num_workers=33", "num_workers should be at most num_envs=32, or auto, not 33"),
        (
            "flow=estimated flow.estimator=raft_small",
            "flow.weights is missing: estimator=raft_small needs flow.weights=<file>",
        ),
        (
            "noise.depth_dropout=1.5 noise.drift_m=-1",
            "noise.depth_dropout should be a number from 0 to 1, not 1.5\n"
            "noise.drift_m should be a number from 0, not -1",
        ),
        (
            "flow=estimated flow.weights=raft.pth",
            "flow.weights should be null with estimator=dis, not 'raft.pth'",
        ),
    ],
)
def test_values_that_do_not_go_together_are_named(line, expected):
    assert refusal("train", TrainConfig, line) == expected


@pytest.mark.parametrize(
    "line",
    [
        "algorithm.replay_capacity=1024",
        "total_frames=5000 algorithm.learning_starts=4990",
        "algorithm.batch_size=32",
        "algorithm=ppo algorithm.rollout_length=8",
        "algorithm=ppo total_frames=2048",
        "num_workers=32",
        "seed=2147483647",
        "algorithm.gamma=1 algorithm.tau=1 evaluation.baselines=[]",
    ],
)
def test_what_just_can_be_passes(line):
    config = plain("train", *line.split())
    assert validated(TrainConfig, config).seed == config["seed"]


def test_a_key_that_an_algorithm_does_not_have_is_named():
    message = refusal("train", TrainConfig, "+algorithm.gama=0.9")
    assert message.startswith("unknown key 'gama' of 'algorithm' (did you mean 'gamma'?); there ")
    assert "learning_rate" in message
    message = refusal("train", TrainConfig, "algorithm=ppo +algorithm.tau=0.1")
    assert message.startswith("unknown key 'tau' of 'algorithm'; there are: ")


def test_a_key_of_one_s_own_passes_where_it_was_added():
    config = plain("train", "+note=pilot")
    validated(TrainConfig, config, own_keys={"note"})
    with pytest.raises(UsageError, match=r"unknown key 'note'.*; there are: seed, device"):
        validated(TrainConfig, config)


def test_everything_that_is_wrong_is_said_at_once():
    message = refusal("train", TrainConfig, "algorithm.gamma=2 evaluation.episodes=0 seed=x")
    assert [line.split()[0] for line in message.splitlines()] == [
        "seed", "evaluation.episodes", "algorithm.gamma"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("", "'run' needs a value: run=..."),
        ("run=null", "'run' needs a value: run=..."),
        (
            "run=3",
            "run should be a run folder, or a sweep's, or a list of different such values, or "
            "null, not 3",
        ),
        (
            "run=here policy=mine.py:make scene=s_turn representations=[ego]",
            "run and policy=mine.py:make can't be combined: give one of them",
        ),
        ("run=here output=out", "output is for a policy of your own; run= has it in its config"),
        (
            "speed=[]",
            "speed should be low, normal or high, or a list of different such values, not []",
        ),
        (
            "speed=hihg",
            "speed should be low, normal or high, or a list of different such values, not 'hihg' "
            "(did you mean 'high'?)",
        ),
        (
            "fps=[]",
            "fps should be a number from 0.5 to 1000, or a list of different such values, not []",
        ),
        (
            "fps=nan",
            "fps should be a number from 0.5 to 1000, or a list of different such values, not nan",
        ),
        (
            "fps=[12,12.0]",
            "fps should be a number from 0.5 to 1000, or a list of different such values, "
            "not [12, 12.0]",
        ),
        (
            "fps=[12,0]",
            "fps should be a number from 0.5 to 1000, or a list of different such values, "
            "not [12, 0]",
        ),
        (
            "policy=[]",
            "policy should be greedy, sampled, path.py:make, package.module:make or path.pt2, or a "
            "list of different such values, not []",
        ),
        (
            "policy=gredy",
            "policy should be greedy, sampled, path.py:make, package.module:make or path.pt2, or a "
            "list of different such values, not 'gredy' (did you mean 'greedy'?)",
        ),
        (
            "policy=[greedy,mine.py:make]",
            "policy should be greedy, sampled, or your own, not both",
        ),
        ("episodes=0", "episodes should be a positive whole number, not 0"),
        ("video=true", "video should be a whole number from 0, not true"),
    ],
)
def test_an_evaluation_that_can_not_be_is_refused(line, expected):
    line = line if "run" in line + expected else f"run=here {line}"
    assert refusal("evaluate", EvaluateConfig, line) == expected


@pytest.mark.parametrize("line", ["speed=low fps=6 policy=sampled baselines=[]", "fps=[6,7.5]"])
def test_an_evaluation_takes_one_value_or_a_list(line):
    config = plain("evaluate", "run=here", *line.split())
    assert validated(EvaluateConfig, config).fps == config["fps"]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("policy=pilot", "policy should be planner, never_turn or random, not 'pilot'"),
        ("speed=fast", "speed should be low, normal or high, not 'fast'"),
        ("episodes=0", "episodes should be a positive whole number, not 0"),
        ("sheet_rows=true", "sheet_rows should be a positive whole number, not true"),
        ("seed=-1", "seed should be a whole number from 0 to 2147483647, not -1"),
        ("frame_rate_hz=0", "frame_rate_hz should be a number from 0.5 to 1000, or null, not 0"),
        (
            "frame_rate_hz=slow",
            "frame_rate_hz should be a number from 0.5 to 1000, or null, not 'slow'",
        ),
        ("interactive=maybe", "interactive should be true or false, not 'maybe'"),
    ],
)
def test_a_look_that_can_not_be_is_refused(line, expected):
    assert refusal("view", ViewConfig, line) == expected


def test_what_is_wrong_in_a_run_folder_is_named_with_the_file():
    config = plain("train")
    assert validated_run(config, "config.yaml") == config
    config["algorithm"]["n_steps"] = 0
    with pytest.raises(UsageError, match=r"^config.yaml: algorithm.n_steps should be a positive"):
        validated_run(config, "config.yaml")
    config = plain("train")
    del config["renderer"]
    with pytest.raises(UsageError, match=r"^config.yaml: 'renderer' needs a value"):
        validated_run(config, "config.yaml")


@pytest.mark.parametrize("config", [None, [], "text", 3])
def test_a_file_that_is_no_config_is_named(config):
    with pytest.raises(UsageError) as caught:
        validated_run(config, "runs/a/config.yaml")
    assert str(caught.value).startswith("runs/a/config.yaml: should be a section with the keys ")
