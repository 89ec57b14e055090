"""Every key of conf/ is in the schema, every key of the schema in conf/, and neither repeats."""

import pytest
from omegaconf import OmegaConf

pytest.importorskip("pybullet", reason="the schema reads the simulator's names")

from flowrep.config import validated
from flowrep.config.algorithms import ALGORITHMS
from flowrep.config.evaluating import EvaluateConfig
from flowrep.config.exporting import ExportConfig
from flowrep.config.factorizing import FactorizeConfig
from flowrep.config.recordings import READERS
from flowrep.config.reporting import ReportConfig
from flowrep.config.representations import EstimatedFlow, ExactFlow, Noise, Representations
from flowrep.config.training import Evaluation, TrainConfig
from flowrep.config.viewing import ViewConfig
from flowrep.config_tree import CONF_DIR, config_groups, group_choices
from flowrep.transforms.stack import NOISE_OPTIONS
from tests.config.composing import plain

OF_TRAINING = [group for group in config_groups() if group != "format"]
GROUP_FILES = [(group, name) for group in OF_TRAINING for name in group_choices(group)]


@pytest.mark.parametrize(
    ("name", "schema", "given"),
    [
        ("train", TrainConfig, []),
        (
            "evaluate",
            EvaluateConfig,
            [
                "policy=a.py:make",
                "scene=s_turn",
                "flow=exact",
                "noise=none",
                "representations=[ego]",
            ],
        ),
        ("export", ExportConfig, ["run=x"]),
        ("view", ViewConfig, []),
        ("factorize", FactorizeConfig, ["format=tum", "input=x", "output=y"]),
        ("report", ReportConfig, ["run=x"]),
    ],
    ids=["train", "evaluate", "export", "view", "factorize", "report"],
)
def test_a_command_has_the_keys_of_its_schema(name, schema, given):
    config = plain(name, *given)
    assert sorted(config) == sorted(schema.keys())
    validated(schema, config)


@pytest.mark.slow_after_first
@pytest.mark.parametrize(("group", "name"), GROUP_FILES, ids="/".join)
def test_every_choice_of_every_group_is_right(group, name):
    choice = f"representations=[{name}]" if group == "representations" else f"{group}={name}"
    given = ["flow.weights=file"] if name == "raft" else []
    config = plain("train", choice, *given)
    assert validated(TrainConfig, config).algorithm.target == config["algorithm"]["_target_"]


def keys_of(*place):
    return sorted(OmegaConf.load(CONF_DIR.joinpath(*place).with_suffix(".yaml")))


@pytest.mark.parametrize("name", group_choices("algorithm"))
def test_an_algorithm_has_the_keys_of_its_section(name):
    section = plain("train", f"algorithm={name}")["algorithm"]
    assert sorted(section) == sorted(ALGORITHMS[section["_target_"]].keys())


@pytest.mark.parametrize("name", group_choices("format"))
def test_a_format_has_the_keys_of_its_section(name):
    target = OmegaConf.load(CONF_DIR / "format" / f"{name}.yaml")["_target_"]
    assert keys_of("format", name) == sorted(READERS[target].keys())


def test_every_section_has_its_file():
    formats = {
        OmegaConf.load(CONF_DIR / "format" / f"{name}.yaml")["_target_"]
        for name in group_choices("format")
    }
    assert formats == set(READERS)
    targets = {
        OmegaConf.load(CONF_DIR / "algorithm" / f"{name}.yaml")["_target_"]
        for name in group_choices("algorithm")
    }
    assert targets == set(ALGORITHMS)
    assert group_choices("representations") == sorted(Representations.keys())


@pytest.mark.slow
def test_the_other_sections_have_the_keys_of_their_files():
    assert keys_of("flow", "exact") == sorted(ExactFlow.keys())
    assert keys_of("flow", "estimated") == sorted(EstimatedFlow.keys())
    for name in group_choices("noise"):
        assert keys_of("noise", name) == sorted(Noise.keys()) == sorted(NOISE_OPTIONS)
    assert sorted(plain("train")["evaluation"]) == sorted(Evaluation.keys())
    for name in group_choices("representations"):
        section = Representations.model_fields[name].annotation
        assert sorted(plain("train", f"representations=[{name}]")["representations"][name]) == (
            sorted(section.keys())
        )
