"""What a config names is checked before it is called."""

import sys

import pytest

pytest.importorskip("pybullet", reason="a run is built with the simulator")

from flowrep.agent import DoubleDQN
from flowrep.config import UsageError
from flowrep.config.schema import ALGORITHMS, AnyAlgorithm
from flowrep.experiment.build import algorithm_class, device


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    """A module `someones` with an algorithm."""
    (tmp_path / "someones.py").write_text(
        "from flowrep.agent import DoubleDQN\n"
        "class Learner(DoubleDQN):\n"
        "    def __init__(self, observation_spec, action_spec, keys, *, total_frames, device,\n"
        "                 patience, mood=1.0): ...\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("someones", None)


def named(target, **options):
    return AnyAlgorithm.model_validate({"_target_": target, **options})


@pytest.mark.usefixtures("own_module")
def test_an_algorithm_is_found_by_its_name():
    assert algorithm_class(named("flowrep.agent.DoubleDQN")) is DoubleDQN
    assert all(algorithm_class(named(target)) for target in ALGORITHMS)
    assert algorithm_class(named("someones.Learner", patience=3)).__name__ == "Learner"


@pytest.mark.parametrize(
    ("target", "options", "says"),
    [
        ("os.system", {}, "Algorithm"),
        ("collections.OrderedDict", {}, "Algorithm"),
        ("flowrep.agent.load_checkpoint", {}, "Algorithm"),
        ("nowhere.Learner", {}, "nowhere"),
        ("someones.Nobody", {"patience": 3}, "Nobody"),
        ("someones.Learner", {}, "patience"),
        ("someones.Learner", {"patience": 3, "moood": 2}, "moood.*mood"),
    ],
)
@pytest.mark.usefixtures("own_module")
def test_what_is_no_algorithm_is_refused(target, options, says):
    with pytest.raises(UsageError, match=says):
        algorithm_class(named(target, **options))


def test_a_device_that_is_not_there_is_named():
    assert device("cpu").type == "cpu"
    with pytest.raises(ValueError, match="device=cuda:99"):
        device("cuda:99")
