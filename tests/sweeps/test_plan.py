"""Which runs a sweep has, before it begins, and where they go."""

import sys
from importlib.util import find_spec

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

pytest.importorskip("pybullet", reason="the schema reads the simulator's names")

from flowrep.config import UsageError
from flowrep.config.command_line import register_resolvers
from flowrep.config.composition import check_command
from flowrep.config.run_names import run_of_sweep
from flowrep.config_tree import CONF_DIR
from flowrep.sweeps.plan import is_sweep, plan_of

register_resolvers()


def test_a_plan_names_the_runs_that_hydra_will_make(tmp_path):
    line = f"-m preset=laptop representations=[ego],[ego,obj] seed=0,1 hydra.sweep.dir={tmp_path}"
    plan = plan_of("train", line.split())
    assert plan.folder == tmp_path
    assert plan.total == 4
    stacks = ("ego", "ego+obj")
    assert plan.names == tuple(f"laptop_{maps}_s{seed}" for maps in stacks for seed in (0, 1))
    with initialize_config_dir(str(CONF_DIR), version_base="1.3"):
        job = ["preset=laptop", "representations=[ego,obj]", "seed=1"]
        config = compose("train", job, return_hydra_config=True)
    OmegaConf.set_readonly(config.hydra, False)
    assert config.hydra.sweep.subdir == plan.names[-1]


@pytest.mark.slow
def test_a_sweepers_own_runs_are_counted_and_found_by_their_logs(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    line = [
        "-m", "hydra/sweeper=optuna", "hydra.sweeper.n_trials=7",
        "algorithm.tau=interval(0.001,0.1)", f"hydra.sweep.dir={tmp_path}",
    ]  # fmt: skip
    plan = plan_of("train", line)
    assert (plan.total, plan.names, plan.folders()) == (7, (), [])
    direction, failures = plan.options
    assert direction == "hydra.sweeper.direction=maximize"
    assert failures == "hydra.sweeper.max_failure_rate=1.0"
    plan = plan_of("train", [*line, "hydra.sweeper.direction=minimize"])
    assert plan.options == (failures,)
    for name in ("b", "a", "nothing"):
        (tmp_path / name).mkdir()
    for name in ("b", "a"):
        (tmp_path / name / "job.log").touch()
    assert plan.folders() == [tmp_path / "a", tmp_path / "b"]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("-m seed=0,0", "two runs would share the folder s0"),
        ("-m resume=outputs/a", "resume= continues one run"),
    ],
)
def test_what_is_no_sweep_is_refused(line, says):
    with pytest.raises(UsageError, match=says):
        plan_of("train", line.split())


@pytest.mark.skipif(bool(find_spec("ray")), reason="Ray is installed")
@pytest.mark.parametrize("has_others", [True, False])
def test_a_launcher_that_lacks_its_package_says_which(monkeypatch, has_others):
    if not has_others:  # as without the extra `sweep`
        monkeypatch.setitem(sys.modules, "hydra_plugins", None)
    with pytest.raises(UsageError, match="pip install hydra-ray-launcher"):
        check_command("train", ["-m", "hydra/launcher=ray_jobs", "seed=0,1"])


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("-m seed=0,1", True),
        ("seed=0 --multirun", True),
        ("hydra.mode=MULTIRUN seed=0,1", True),
        ("seed=0", False),
        ("-m seed=0,1 --cfg job", False),
        ("", False),
    ],
)
def test_several_runs_are_asked_for_in_hydras_ways(line, expected):
    assert is_sweep(line.split()) is expected


def test_names_need_no_quotes_and_stay_apart():
    odd = run_of_sweep(["+note='a b/../c'", "representations=[ego,obj]", "~debug", "num_workers=2"])
    assert odd == "ego+obj_note-ab_.._c__debug"
    long = ["seed=3", *(f"evaluation.some_long_key_{i}=123456" for i in range(9))]
    names = {run_of_sweep(long), run_of_sweep([*long[:-1], "evaluation.some_long_key_8=123457"])}
    assert len(names) == 2
    assert all(name.startswith("s3_") and len(name) < 120 for name in names)
