"""What a config names is checked before it is called."""

import sys

import pytest
import torch

pytest.importorskip("pybullet", reason="a run is built with the simulator")

from flowrep.agent import DoubleDQN, precision
from flowrep.config.algorithms import ALGORITHMS
from flowrep.config.usage import UsageError
from flowrep.experiment import build
from flowrep.experiment.build import algorithm
from flowrep.experiment.schema import ForeignAlgorithm
from tests.config.composing import composed


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    """A module `someones` with an algorithm."""
    (tmp_path / "someones.py").write_text(
        "from flowrep.agent import DoubleDQN\n"
        "from flowrep.config.algorithms import AlgorithmOptions, DoubleDQNOptions\n"
        "from flowrep.config.options import Count, Positive\n"
        "class Learner(DoubleDQN):\n"
        "    class OPTIONS(AlgorithmOptions):\n"
        "        patience: Count\n"
        "        mood: Positive = 1.0\n"
        "class Other(DoubleDQN):\n"
        "    class OPTIONS(DoubleDQNOptions):\n"
        "        patience: Count\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("someones", None)


def named(target, **options):
    return ForeignAlgorithm.model_validate({"_target_": target, **options})


@pytest.mark.usefixtures("own_module")
def test_an_algorithm_is_found_by_its_name():
    assert algorithm(composed("algorithm=dqn").algorithm)[0] is DoubleDQN
    for target, options in ALGORITHMS.items():
        assert algorithm(named(target))[0].OPTIONS is options
    maker, options = algorithm(named("someones.Learner", patience=3))
    assert maker.__name__ == "Learner"
    assert (options.patience, options.mood) == (3, 1.0)


@pytest.mark.parametrize(("faster", "chosen"), [(True, "bf16"), (False, "fp32")])
@pytest.mark.usefixtures("own_module")
def test_a_new_run_s_config_says_in_which_format_it_computes(monkeypatch, faster, chosen):
    monkeypatch.setattr(precision, "has_bf16", lambda device: True)
    monkeypatch.setattr(precision, "_bf16_products_are_faster", lambda: faster)

    def stored(section):
        config = composed("device=cpu").model_copy(update={"algorithm": section})
        resolved = build.with_precision(config, torch.device("cpu"))
        return resolved.plain()["algorithm"].get("precision")

    section = composed("device=cpu").algorithm
    assert section.precision == "auto"
    assert stored(section) == chosen
    for given in ("bf16", "fp32"):
        assert stored(section.model_copy(update={"precision": given})) == given
    assert stored(named("someones.Learner", patience=3)) is None  # has no such option
    assert stored(named("someones.Other", patience=3)) == chosen  # has it, with a default


@pytest.mark.parametrize(
    ("target", "options", "says"),
    [
        ("os.system", {}, "Algorithm"),
        ("collections.OrderedDict", {}, "Algorithm"),
        ("flowrep.agent.load_checkpoint", {}, "Algorithm"),
        ("nowhere.Learner", {}, "nowhere"),
        ("someones.Nobody", {"patience": 3}, "Nobody"),
        ("someones.Learner", {}, "patience"),
        ("someones.Learner", {"patience": 3, "moood": 2}, "algorithm.moood"),
        ("someones.Learner", {"patience": 0}, "algorithm.patience.*1"),
    ],
)
@pytest.mark.usefixtures("own_module")
def test_a_target_that_is_no_algorithm_is_refused(target, options, says):
    with pytest.raises(UsageError, match=says):
        algorithm(named(target, **options))


@pytest.mark.parametrize(
    ("cores", "device", "change", "workers"),
    [
        (1, "cpu", "motion=exact", 0),
        (2, "cpu", "threads=1", 1),
        (2, "cpu", "threads=2", 0),
        (2, "cpu", "num_workers=2", 2),
        (2, "cuda", "motion=exact", 2),
        (3, "cpu", "threads=1", 2),
        (16, "cpu", "threads=1", 4),  # one for each environment
    ],
)
def test_workers_step_a_training_s_envs_where_cores_are_free(
    monkeypatch, cores, device, change, workers
):
    monkeypatch.setattr("flowrep.experiment.build.available_cores", lambda: cores)
    config = composed(change, "num_envs=4", "algorithm.batch_size=64")
    assert build.training_workers(config, torch.device(device)) == workers


@pytest.mark.parametrize(
    ("cores", "asked", "num_envs", "workers"),
    [
        (2, "auto", 96, 2),
        (2, "auto", 47, 0),  # one process would have fewer than 24
        (16, "auto", 96, 4),
        (1, "auto", 96, 0),
        (2, 0, 96, 0),
        (2, 3, 96, 3),
        (2, 3, 2, 2),  # the last episodes of many workers
    ],
)
def test_an_evaluation_is_stepped_by_a_process_a_core_if_each_has_enough_to_do(
    monkeypatch, cores, asked, num_envs, workers
):
    monkeypatch.setattr("flowrep.experiment.build.available_cores", lambda: cores)
    config = composed("device=cpu").model_copy(update={"num_workers": asked})
    assert build.evaluation_workers(config, num_envs) == workers


@pytest.mark.parametrize(
    "line",
    [
        "representations.ego.scale=nan",
        "+representations.ego.k=2",
        "noise.depth_dropout=1.5",
        "flow.estimator=abc flow=estimated",
        "+flow.preset=fast",  # of exact flow
        "threads=1000",
        "device=cuda:93",
    ],
)
def test_what_a_transform_or_a_machine_refuses_is_named_before_a_run_has_a_folder(line):
    key = line.split()[0].partition("=")[0].rpartition(".")[2].lstrip("+")
    with pytest.raises(ValueError, match=key):
        build.resolved(composed(*line.split()))
