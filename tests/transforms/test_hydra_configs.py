"""One config per transform, with the class's own names and defaults."""

from __future__ import annotations

import dataclasses
import inspect

import pytest
import torch
from hydra.core.config_store import ConfigStore
from torchrl.envs.transforms import Transform

from flowrep import transforms
from flowrep.config import CONF_DIR, group_choices
from flowrep.transforms import REPRESENTATIONS, representation_options, representation_stack

hydra = pytest.importorskip("hydra")


configs = pytest.importorskip("flowrep.transforms.hydra_configs", exc_type=ImportError)


omegaconf = pytest.importorskip("omegaconf")


CLASSES = {
    name: value
    for name, value in vars(transforms).items()
    if inspect.isclass(value) and issubclass(value, Transform)
}


K = [[6.0, 0.0, 3.2], [0.0, 5.0, 2.1], [0.0, 0.0, 1.0]]


# What each transform can't be made without.
REQUIRED = {
    "AdaptDepth": {"kind": "z"},
    "AdaptFlow": {"direction": "backward", "grid": "current"},
    "EstimateCameraMotion": {"intrinsics": K},
    "FlowFactorize": {"intrinsics": K},
    "FrameStack": {"in_keys": ["seg", ["sensor", "depth"]], "out_keys": ["seg2", ["a", "b"]]},
    "InstanceIds": {"body_ids": [17, 3]},
    "Mirror": {"in_keys": ["raw", ["a", "seg"]], "swapped_actions": [0, 2, 1]},
    "RawFlow": {"intrinsics": K},
    "Segmentation": {"num_classes": 5},
}


def config_of(name: str) -> type:
    return getattr(configs, f"{name}Config")


def group_name(name: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")


def test_there_is_a_config_for_each_transform():
    assert {f"{name}Config" for name in CLASSES} == {
        config.__name__ for config in configs.CONFIGS.values()
    }


@pytest.mark.parametrize("name", CLASSES)
def test_names_and_defaults_are_the_class_s(name):
    parameters = inspect.signature(CLASSES[name]).parameters
    fields = {field.name: field for field in dataclasses.fields(config_of(name))}
    assert list(fields) == [*parameters, "_target_", "_convert_", "_partial_"]
    for parameter in parameters.values():
        default = fields[parameter.name].default
        if parameter.default is inspect.Parameter.empty:
            assert default == omegaconf.MISSING
        elif not isinstance(parameter.default, (tuple, list)) and "keys" not in parameter.name:
            assert default == parameter.default


@pytest.mark.parametrize("name", CLASSES)
def test_hydra_makes_of_the_config_what_python_makes_of_the_class(name):
    stored = ConfigStore.instance().load(f"transform/{group_name(name)}.yaml").node
    required = REQUIRED.get(name, {})
    made = hydra.utils.instantiate(omegaconf.OmegaConf.merge(stored, required))
    by_hand = CLASSES[name](**required)
    assert type(made) is CLASSES[name]
    hidden = {"_modules", "_generator"}
    for attribute, value in vars(by_hand).items():
        got = vars(made)[attribute]
        if attribute == "_buffers":
            assert got.keys() == value.keys()
            assert all(got[key] is value[key] or torch.equal(got[key], value[key]) for key in got)
        elif attribute not in hidden:
            assert got == value, attribute


def test_nested_keys_are_written_as_lists():
    made = hydra.utils.instantiate(configs.RawFlowConfig(intrinsics=["sensor", "K"]))
    assert made.in_keys[-1] == ("sensor", "K")
    stack = hydra.utils.instantiate(configs.FrameStackConfig(**REQUIRED["FrameStack"]))
    assert stack.in_keys == ["seg", ("sensor", "depth")]
    assert stack.out_keys == ["seg2", ("a", "b")]


def test_partial_gives_a_maker():
    maker = hydra.utils.instantiate(configs.DepthConfig(_partial_=True, range_m=50.0))
    assert maker().range_m == 50.0


def test_an_option_that_does_not_exist_is_refused():
    stored = ConfigStore.instance().load("transform/depth.yaml").node
    with pytest.raises(omegaconf.errors.ConfigKeyError, match="rangem"):
        omegaconf.OmegaConf.merge(stored, {"rangem": 3})


def test_composed_by_a_project_s_own_config_beside_torchrl_s(tmp_path):
    example = configs.__doc__.partition("```yaml")[2].partition("```")[0]
    (tmp_path / "main.yaml").write_text(example)
    with hydra.initialize_config_dir(str(tmp_path), version_base="1.3"):
        config = hydra.compose("main", overrides=["raw.scale=0.5", "raw.outputs=[raw,valid]"])
    raw, split = hydra.utils.instantiate(config.stack)
    assert (raw.outputs, raw.factors) == (("raw", "valid"), {"raw": 0.5})
    assert (split.outputs, split.in_keys[-1]) == (("obj",), ("sensor", "K"))


yaml = pytest.importorskip("yaml")


CAMERA = [[42.0, 0.0, 42.0], [0.0, 42.0, 42.0], [0.0, 0.0, 1.0]]


def read(name: str) -> dict:
    return yaml.safe_load((CONF_DIR / "representations" / f"{name}.yaml").read_text())


def test_there_is_a_file_for_each_representation():
    assert sorted(REPRESENTATIONS) == group_choices("representations")


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_file_names_the_representation_and_spells_its_options(name):
    config = read(name)
    assert list(config) == [name]
    assert list(config[name]) == list(representation_options(name))


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_an_experiment_changes_nothing_of_a_representation(name):
    # the flows' scale among it: one factor for all, so that scale decides no comparison
    assert read(name)[name] == representation_options(name)


def test_all_files_together_make_a_stack():
    chosen = {name: read(name)[name] for name in REPRESENTATIONS}
    assert representation_stack(chosen, intrinsics=CAMERA, num_classes=5)
