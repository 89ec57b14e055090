"""What a config names is checked before it is called, and built as it says."""

import sys

import pytest
import torch

from flowrep.agent import DoubleDQN, precision
from flowrep.baselines import BaselinePolicy
from flowrep.config.algorithms import ALGORITHMS
from flowrep.config.usage import UsageError
from flowrep.envs import street_envs
from flowrep.experiment import build
from flowrep.experiment.build import algorithm
from flowrep.experiment.schema import ForeignAlgorithm
from flowrep.geometry import rigid_flow
from flowrep.transforms import EstimateCameraMotion
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


@pytest.fixture
def cores(monkeypatch):
    """Sets how many cores the machine has."""
    return lambda n: monkeypatch.setattr("flowrep.experiment.build.available_cores", lambda: n)


def test_workers_step_a_training_s_envs_where_cores_are_free(cores):
    def workers(available, change="threads=1", device="cpu"):
        cores(available)
        config = composed(change, "num_envs=4", "algorithm.batch_size=64")
        return build.training_workers(config, torch.device(device))

    assert [workers(n) for n in (1, 2, 3, 16)] == [0, 1, 2, 4]  # one for each environment
    assert workers(2, "threads=2") == 0
    assert workers(2, "num_workers=2") == 2
    assert workers(2, device="cuda") == 2


def test_an_evaluation_is_stepped_by_a_process_a_core_if_each_has_enough_to_do(cores):
    def workers(available, num_envs, asked="auto"):
        cores(available)
        config = composed("device=cpu").model_copy(update={"num_workers": asked})
        return build.evaluation_workers(config, num_envs)

    assert [workers(n, 96) for n in (1, 2, 16)] == [0, 2, 4]
    assert workers(2, 47) == 0  # one process would have fewer than 24
    assert [workers(2, 96, asked) for asked in (0, 3)] == [0, 3]
    assert workers(2, 2, 3) == 2  # the last episodes of many workers


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


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["exact", "estimated"])
def test_with_the_camera_compensated_what_stands_still_has_hardly_any_object_flow(motion):
    options = ["preset=laptop", "flow=estimated", f"motion={motion}", "representations=[ego,obj]"]
    options += ["num_envs=2", "num_workers=0", "device=cpu"]
    env = build.env(composed(*options), keep_sensor=True, seed=0)
    estimators = [each for each in env.transform if isinstance(each, EstimateCameraMotion)]
    assert len(estimators) == (motion == "estimated")
    planner, streets = BaselinePolicy("planner"), torch.arange(2)
    planner.enter(env)
    frames = env.rollout(24, lambda td: planner(td.set("env_id", streets)))["next"]
    K, sensor = torch.as_tensor(street_envs(env)[0].K).float(), frames["sensor"]
    env.close()
    depth, ids, motions = (sensor[key] for key in ("depth", "instance", "instance_motion"))
    exact = (rigid_flow(depth, ids, K, motions).flow - frames["ego"]).norm(dim=-3, keepdim=True)
    moved = frames["obj"].norm(dim=-3, keepdim=True)
    static = (ids == 0) & depth.isfinite()
    assert (moved[static] > 1.0).float().mean() < 0.01  # 0.1 without
    assert moved[exact > 0.5].median() > 0.5
