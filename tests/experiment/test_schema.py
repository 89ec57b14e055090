"""The schema: what can't be is refused by its key."""

import pytest

from flowrep.config.options import validated
from flowrep.config.usage import UsageError
from flowrep.experiment.schema import TrainConfig, validated_run
from flowrep.scenes import Scene
from tests.config.composing import composed, config_of, plain, schema_of


def refusal(command, line):
    with pytest.raises(UsageError) as caught:
        config_of(command, *line.split())
    return str(caught.value)


@pytest.mark.parametrize(
    "line",
    [
        # types and ranges
        "algorithm.gamma=2", "algorithm.gamma=nan", "algorithm.n_steps=0", "algorithm.tau=0",
        "algorithm.learning_rate=inf", "algorithm.batch_size=1.5",
        "algorithm.initial_epsilon=3 algorithm=dqn", "evaluation=null", "evaluation.speeds=[]",
        "evaluation.speeds=normal", "evaluation.speeds=[low,low]", "evaluation.fps=[12,0.1]",
        "evaluation.policies=[greedy,random]", "total_frames=2e6", "seed=-1", "device=meta",
        "representations=[]", "representations.ego=null", "+representations.rgb=null",
        # keys
        "~seed", "+algorithm.gama=0.9", "+algorithm.tau=0.1 algorithm=ppo",
        # what leaves nothing to learn
        "algorithm.learning_starts=4991 total_frames=5000",
        "algorithm.batch_size=31",
        "algorithm.initial_epsilon=0.04 algorithm=dqn",  # which only falls, to 0.05
        "algorithm.value_weight=0 algorithm=ppo",
        "algorithm.replay_capacity=8 algorithm.n_steps=10 debug=smoke",
        "algorithm.rollout_length=64 algorithm=ppo total_frames=2047",
        "algorithm.replay_capacity=63 num_envs=32",
        "algorithm.batch_size=2049 algorithm=ppo",
    ],
)  # fmt: skip
def test_an_impossible_value_is_refused_by_its_key(line):
    key = line.split()[0].split("=")[0].lstrip("~+").split(".")[-1]
    assert key in refusal("train", line)


@pytest.mark.parametrize(
    "line",
    [
        "total_frames=5000 algorithm.learning_starts=4990",
        "algorithm.batch_size=32",
        "algorithm=ppo total_frames=2048",
        "algorithm.replay_capacity=64 num_envs=32",
        "seed=2147483647 algorithm.gamma=1 algorithm.tau=1 evaluation.baselines=[]",
        "resume=there total_frames=512",  # the run's own algorithm decides whether that is enough
        "algorithm._target_=my.Own +algorithm.mine=3",
    ],
)
def test_values_at_the_edge_of_what_is_possible_pass(line):
    assert composed(*line.split()).seed >= 0


def test_a_final_evaluation_has_as_many_episodes_as_was_asked():
    asked = "final_episodes=5", "speeds=[low,high]", "policies=[greedy]", "baselines=[random]"
    config = composed(*(f"evaluation.{each}" for each in asked))
    assert config.evaluation.final_total == 5 * 2 * 2


def test_representations_keep_the_order_of_the_command_line():
    config = composed("representations=[seg2,ego,obj]")
    assert list(config.plain()["representations"]) == ["seg2", "ego", "obj"]


@pytest.mark.parametrize(
    "line",
    [
        "run=3", "run=[]", "policy=mine.py:make run=here scene=s_turn representations=[ego]",
        "output=out run=here", "speed=[] run=here", "speed=hihg run=here", "fps=[12,12.0] run=here",
        "policy=gredy run=here", "policy=[greedy,mine.py:make]",
    ],
)  # fmt: skip
def test_an_impossible_evaluation_is_refused_by_its_key(line):
    assert line.split("=")[0] in refusal("evaluate", line)


def test_an_evaluation_needs_runs_or_a_policy_with_its_scene():
    assert "run" in refusal("evaluate", "")
    assert "scene" in refusal("evaluate", "policy=a.py:make representations=[ego]")


def test_an_evaluation_takes_one_value_or_a_list():
    line = "run=here speed=low fps=6 policy=sampled baselines=[]"
    one = config_of("evaluate", *line.split())
    assert (one.run, one.speed, one.fps, one.baselines) == (["here"], ["low"], [6], [])
    more = config_of("evaluate", "run=[a,b]", "fps=[6,7.5]")
    assert (more.run, more.fps) == (["a", "b"], [6, 7.5])


def test_what_is_wrong_in_a_run_folder_is_named_with_the_file():
    config = plain("train", "+note=pilot") | {"of_an_older_version": None}
    assert validated_run(config, "config.yaml").plain() == config
    config["algorithm"]["n_steps"] = 0
    with pytest.raises(UsageError, match=r"^config.yaml: algorithm.n_steps"):
        validated_run(config, "config.yaml")
    del config["seed"], config["evaluation"]["video"]
    with pytest.raises(UsageError, match=r"^config.yaml lacks seed, evaluation.video; [^\n]*$"):
        validated_run(config, "config.yaml")
    with pytest.raises(UsageError, match=r"config.yaml"):
        validated_run(None, "config.yaml")


# The schema and conf/ have the same keys.


NEEDED = {
    "train": "",
    "evaluate": "policy=a.py:make scene=s_turn flow=exact noise=none representations=[ego]",
    "view": "scene=s_turn representations=[ego]",
    "factorize": "format=tum input=x output=y",
    "report": "run=x",
}


@pytest.mark.parametrize("command", NEEDED)
def test_a_command_has_the_keys_of_its_schema(command):
    given = NEEDED[command].split()
    assert sorted(plain(command, *given)) == sorted(schema_of(command).model_fields)
    config_of(command, *given)


def test_a_configs_scene_is_checked_and_stored_as_it_was_written():
    written = plain("train", "scene=s_turn", "scene.time_limit_steps=7")
    config = validated(TrainConfig, written)
    assert isinstance(config.scene, Scene)
    assert (config.scene.name, config.scene.time_limit_steps) == ("s_turn", 7)
    assert config.plain()["scene"] == written["scene"]
    assert validated_run(config.plain(), "config.yaml").scene == config.scene


@pytest.mark.parametrize(
    ("scene", "says"),
    [
        ({"name": "s_turn"}, "scene 's_turn': frame_rate_hz"),
        ("s_turn", "scene: "),  # of a stored config, which must not name a file to read
        ("elsewhere.yaml", "scene: "),
        (None, "scene: "),
    ],
)
def test_a_section_that_is_no_scene_is_refused_by_its_key(scene, says):
    with pytest.raises(UsageError) as caught:
        validated(TrainConfig, plain("train") | {"scene": scene})
    assert str(caught.value).startswith(says)
    assert "\n" not in str(caught.value)
