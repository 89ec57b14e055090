"""One config per transform, with the class's own names and defaults; and conf/representations."""

from __future__ import annotations

import pytest

from flowrep import transforms
from flowrep.config import CONF_DIR, group_choices
from flowrep.transforms import REPRESENTATIONS, representation_options, representation_stack
from tests.transforms.fake_env import INTRINSICS

hydra = pytest.importorskip("hydra")
configs = pytest.importorskip("flowrep.transforms.hydra_configs", exc_type=ImportError)
omegaconf = pytest.importorskip("omegaconf")
yaml = pytest.importorskip("yaml")

from hydra.core.config_store import ConfigStore  # noqa: E402

# What a transform can't be made without.
REQUIRED = {
    "adapt_depth": {"kind": "z"},
    "adapt_flow": {"direction": "backward", "grid": "current"},
    "estimate_camera_motion": {"intrinsics": INTRINSICS},
    "flow_factorize": {"intrinsics": INTRINSICS},
    "frame_stack": {"in_keys": ["seg", ["sensor", "depth"]], "out_keys": ["seg2", ["a", "b"]]},
    "instance_ids": {"body_ids": [17, 3]},
    "mirror": {"in_keys": ["raw", ["a", "seg"]], "swapped_actions": [0, 2, 1]},
    "raw_flow": {"intrinsics": INTRINSICS},
    "segmentation": {"num_classes": 5},
}


def stored(name: str):
    return ConfigStore.instance().load(f"transform/{name}.yaml").node


@pytest.mark.parametrize("name", configs.CONFIGS)
def test_hydra_makes_of_the_config_what_python_makes_of_the_class(name):
    required = REQUIRED.get(name, {})
    made = hydra.utils.instantiate(omegaconf.OmegaConf.merge(stored(name), required))
    class_name = name.title().replace("_", "")
    by_hand = getattr(transforms, class_name)(**required)
    assert type(made) is type(by_hand)
    assert (made.in_keys, made.out_keys) == (by_hand.in_keys, by_hand.out_keys)


def test_nested_keys_are_written_as_lists():
    made = hydra.utils.instantiate(configs.CONFIGS["raw_flow"], intrinsics=["sensor", "K"])
    assert made.in_keys[-1] == ("sensor", "K")
    stack = hydra.utils.instantiate(configs.CONFIGS["frame_stack"], **REQUIRED["frame_stack"])
    assert stack.in_keys == ["seg", ("sensor", "depth")]
    assert stack.out_keys == ["seg2", ("a", "b")]


def test_composed_by_a_project_s_own_config_beside_torchrl_s(tmp_path):
    example = configs.__doc__.partition("```yaml")[2].partition("```")[0]
    (tmp_path / "main.yaml").write_text(example)
    with hydra.initialize_config_dir(str(tmp_path), version_base="1.3"):
        config = hydra.compose("main", overrides=["raw.scale=0.5", "raw.outputs=[raw,valid]"])
    raw, split = hydra.utils.instantiate(config.stack)
    assert (raw.outputs, raw.scales) == (("raw", "valid"), {"raw": 0.5})
    assert (split.outputs, split.in_keys[-1]) == (("obj",), ("sensor", "K"))
    assert split.scales == {"obj": 1.0}  # the constructor's default


def test_each_representation_s_file_spells_its_options_with_their_defaults():
    assert sorted(REPRESENTATIONS) == group_choices("representations")
    chosen = {}
    for name in REPRESENTATIONS:
        # the flows' scale among it: one factor for all, so that scale decides no comparison
        want = {name: representation_options(name)}
        text = (CONF_DIR / "representations" / f"{name}.yaml").read_text()
        assert yaml.safe_load(text) == want
        assert list(yaml.safe_load(text)[name]) == list(want[name])
        chosen |= yaml.safe_load(text)
    representation_stack(chosen, intrinsics=INTRINSICS, num_classes=5)
