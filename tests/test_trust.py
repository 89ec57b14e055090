"""A run folder may come from somebody else: none of its code runs, and it stays where it is."""

import functools
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

pytest.importorskip("pybullet", reason="a run is built with the simulator")

from flowrep.agent import DoubleDQN
from flowrep.config import UsageError
from flowrep.config.algorithms import ALGORITHMS
from flowrep.config.command_line import register_resolvers
from flowrep.config_tree import CONF_DIR
from flowrep.from_config import algorithm_class
from tests.config.composing import plain


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    """A module `someones` that leaves a trace where it is imported."""
    (tmp_path / "someones.py").write_text(
        "import pathlib\n"
        "from flowrep.agent import DoubleDQN\n"
        "(pathlib.Path(__file__).parent / 'imported').touch()\n"
        "class Learner(DoubleDQN):\n"
        "    def __init__(self, observation_spec, action_spec, keys, *, total_frames, device,\n"
        "                 patience, mood=1.0): ...\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("someones", None)


def test_flowreps_own_algorithms_need_no_trust():
    section = {"_target_": "flowrep.agent.DoubleDQN"}
    assert algorithm_class(section, None) is DoubleDQN
    assert all(algorithm_class({"_target_": target}, None) for target in ALGORITHMS)


@pytest.mark.parametrize("trust", [None, "someones.Learner2", "someones"])
def test_a_class_that_nobody_vouched_for_is_not_even_imported(own_module, trust):
    with pytest.raises(UsageError, match=r"if you trust it, add trust=someones\.Learner$"):
        algorithm_class({"_target_": "someones.Learner", "patience": 3}, trust)
    assert not (own_module / "imported").exists()


def test_a_class_that_was_vouched_for_is_found(own_module):
    section = {"_target_": "someones.Learner", "patience": 3}
    assert algorithm_class(section, "someones.Learner").__name__ == "Learner"
    assert (own_module / "imported").exists()


@pytest.mark.parametrize(
    ("section", "says"),
    [
        ({"_target_": "os.system"}, "algorithm._target_=os.system is not a subclass of"),
        ({"_target_": "collections.OrderedDict"}, "is not a subclass of flowrep.agent.Algorithm"),
        ({"_target_": "nowhere.Learner"}, "can't be imported: No module named 'nowhere'; is its"),
        ({"_target_": "someones.Nobody", "patience": 3}, "can't be imported: "),
        ({"_target_": "someones.Learner"}, "'algorithm.patience' needs a value"),
        (
            {"_target_": "someones.Learner", "patience": 3, "moood": 2},
            "unknown key 'moood' of 'algorithm' (did you mean 'mood'?); someones.Learner has: ",
        ),
    ],
)
@pytest.mark.usefixtures("own_module")
def test_what_is_no_algorithm_is_refused(section, says):
    with pytest.raises(UsageError) as caught:
        algorithm_class(section, section["_target_"])
    assert says in str(caught.value)


def test_an_algorithm_inside_flowrep_that_is_none_of_its_own_needs_trust():
    with pytest.raises(UsageError, match="not one of flowrep's"):
        algorithm_class({"_target_": "flowrep.agent.checkpoint.load_checkpoint"}, None)


@functools.cache
def composed(command):
    register_resolvers()
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        return compose(command, return_hydra_config=True)


@pytest.mark.parametrize("name", ["../../etc", "/etc", "..", "a/b", "..\\b", "x" * 500, ""])
@pytest.mark.parametrize("command", ["train", "view"])
def test_a_scene_s_name_stays_in_the_output_folder(name, command):
    config = composed(command).copy()
    OmegaConf.update(config, "scene.name", name)
    folder = Path(config.hydra.run.dir)
    above = Path("outputs/view") if command == "view" else Path("outputs") / folder.parts[1]
    assert folder.parent == above
    assert folder.name not in ("", ".", "..")
    assert len(folder.name) <= 255


def test_a_config_that_was_read_from_a_folder_resolves_nothing():
    """Interpolations could read the environment; they are text in a run's own config."""
    from flowrep.config.training import validated_run

    config = plain("train") | {"device": "${oc.env:HOME}"}
    with pytest.raises(UsageError, match=r"device should be auto, cpu, cuda"):
        validated_run(config, "config.yaml")
